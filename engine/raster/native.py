"""The back end ``numba``: both passes as a ``torch.autograd.Function``, compiled when first needed."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..machine import memory
from ..machine.compiled import Array
from ..machine.log_compilation import log_compilation
from .arrays import Gaussians, Shapes
from .backward_pass import rasterize_backward
from .conventions import Pinhole
from .forward_pass import Layers, OnImage, as_array, rasterize_forward, top_contributors
from .rendering import GaussianSet, Rendering

LABELS = 5
"""The place of the labels among the arguments."""
COMPILATION = "10 s"
"""The time to compile a pass, for the log."""


def rasterize_native(gaussians: GaussianSet, pinhole: Pinhole, top_k: int, want_means2d_grad: bool) -> Rendering:
    """``rasterize`` for float32 tensors on the CPU. It uses ``torch.get_num_threads()`` threads."""
    count = gaussians.means.shape[0]
    on_image = OnImage(*memory.several(((count, 2), np.float32), (count, np.bool_)))
    # the kernels write to the array; the tensor is an input so that a gradient can reach it
    centres = torch.from_numpy(on_image.means2d)
    if want_means2d_grad:
        centres.requires_grad_()
    image, labels, alpha, depth, *top = _Blend.apply(*gaussians, centres, pinhole, on_image, top_k)
    return Rendering(
        image=image,
        labels=labels if gaussians.labels is not None else None,
        alpha=alpha,
        depth=depth,
        visible=torch.from_numpy(on_image.visible),
        means2d=centres,
        top_indices=top[0] if top else None,
        top_weights=top[1] if top else None,
    )


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        scales: Tensor,
        quats: Tensor,
        opacities: Tensor,
        colours: Tensor,
        labels: Tensor | None,
        centres: Tensor,
        pinhole: Pinhole,
        on_image: OnImage,
        top_k: int,
    ) -> tuple[Tensor, ...]:
        gaussians = Gaussians(*map(as_array, (means, scales, quats, opacities, colours)))
        features = as_array(labels) if labels is not None else np.empty((means.shape[0], 0), np.float32)
        is_compiled = log_compilation("the forward pass of the rasteriser", COMPILATION)
        layers, state = rasterize_forward(gaussians, features, pinhole, on_image)
        is_compiled()
        top: tuple[Tensor, ...] = ()
        if top_k:
            top = top_contributors(state, (pinhole.height, pinhole.width, top_k))
            ctx.mark_non_differentiable(*top)
        ctx.save_for_backward(means, scales, quats)
        ctx.state = state
        ctx.size, ctx.labels_shape = (pinhole.height, pinhole.width), features.shape
        ctx.set_materialize_grads(False)
        return *map(torch.from_numpy, layers.in_order()), *top

    @staticmethod
    def backward(
        ctx: Any,
        d_image: Tensor | None,
        d_labels: Tensor | None,
        d_alpha: Tensor | None,
        d_depth: Tensor | None,
        *_: Any,
    ) -> tuple[Tensor | None, ...]:
        size, needed = ctx.size, ctx.needs_input_grad
        d_layers = Layers(
            _or_zeros(d_image, (*size, 3)),
            _or_zeros(d_labels if needed[LABELS] else None, (*size, 0)),
            _or_zeros(d_alpha, size),
            _or_zeros(d_depth, size),
        )
        shapes = Shapes(*map(as_array, ctx.saved_tensors))
        is_compiled = log_compilation("the backward pass of the rasteriser", COMPILATION)
        gradients = list(rasterize_backward(ctx.state, shapes, d_layers))
        is_compiled()
        if d_labels is None:
            gradients[LABELS] = np.zeros(ctx.labels_shape, np.float32)
        wanted = zip(gradients, needed, strict=False)
        return *(torch.from_numpy(gradient) if need else None for gradient, need in wanted), None, None, None


def _or_zeros(gradient: Tensor | None, shape: tuple[int, ...]) -> Array:
    """A layer's gradient, or zeros, as torch gives None if no loss uses the layer."""
    return _zeros(shape) if gradient is None else as_array(gradient)


@lru_cache(maxsize=2)
def _zeros(shape: tuple[int, ...]) -> Array:
    """Zeros that all passes of one size share and only read. (For arrays marked as read-only, Numba would compile the
    kernels again.)"""
    return np.zeros(shape, np.float32)
