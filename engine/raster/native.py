"""The back end ``numba``: both passes as a ``torch.autograd.Function``, compiled when first needed."""

from __future__ import annotations

import logging
from functools import cache, lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..machine import memory
from ..machine.compiled import Array
from ..machine.crew import worker_count
from ..machine.warm_up import WarmUp
from .backward_pass import LayerGradients, unblend
from .compile_backward import compile_backward
from .conventions import NEAR, View
from .forward_pass import OnImage, as_array, blend, top_contributors
from .kernels import Kernels, choose_kernels
from .rendering import Rendering

log = logging.getLogger("plgs.raster")

LABELS = 5
"""Their place among the arguments."""


def rasterize_native(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    colours: Tensor,
    labels: Tensor | None,
    view: View,
    top_k: int,
    want_means2d_grad: bool,
) -> Rendering:
    """As ``rasterize``, for float32 tensors on the CPU. As many threads as ``torch.get_num_threads()``."""
    count = means.shape[0]
    on_image = OnImage(*memory.several(((count, 2), np.float32), (count, np.bool_)))
    # the kernels write to the array; the tensor is an input so that a gradient can reach it
    centres = torch.from_numpy(on_image.centres)
    if want_means2d_grad:
        centres.requires_grad_()
    inputs = (means, scales, quats, opacities, colours, labels, centres)
    differentiable = any(tensor is not None and tensor.requires_grad for tensor in inputs)
    _warm_up(choose_kernels()).forward(torch.is_grad_enabled() and differentiable)
    image, labels_out, alpha, depth, *top = _Blend.apply(*inputs, view, on_image, top_k)
    return Rendering(
        image=image,
        labels=labels_out if labels is not None else None,
        alpha=alpha,
        depth=depth,
        visible=torch.from_numpy(on_image.visible),
        means2d=centres,
        top_indices=top[0] if top else None,
        top_weights=top[1] if top else None,
    )


@cache
def _warm_up(kernels: Kernels) -> WarmUp:
    """The one warm-up of these kernels in this process."""
    log.info("blending with the %s kernels, %d threads", kernels.name, worker_count())
    apart = compile_backward.__module__
    return WarmUp(f"the {kernels.name} rasteriser", _compile_forward, partial(compile_backward, kernels), apart)


def _compile_forward() -> None:
    """Call every kernel of the forward pass, with one Gaussian."""
    inputs = [torch.ones(shape) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1, 3), (1, 1), (1, 2))]
    view = View((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, -3.0), (1.0, 1.0), (0.5, 0.5), 1, 1, NEAR)
    _Blend.apply(*inputs, view, OnImage(np.empty((1, 2), np.float32), np.empty(1, np.bool_)), 0)


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
        view: View,
        on_image: OnImage,
        top_k: int,
    ) -> tuple[Tensor, ...]:
        gaussians = [as_array(tensor) for tensor in (means, scales, quats, opacities, colours)]
        features = as_array(labels) if labels is not None else np.empty((means.shape[0], 0), np.float32)
        layers, state = blend(choose_kernels(), gaussians, features, view, on_image)
        top: tuple[Tensor, ...] = ()
        if top_k:
            top = top_contributors(state, (view.height, view.width, top_k))
            ctx.mark_non_differentiable(*top)
        ctx.save_for_backward(means, scales, quats)
        ctx.state = state
        ctx.size, ctx.labels_shape = (view.height, view.width), features.shape
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
        _warm_up(ctx.state.kernels).backward()
        size, needed = ctx.size, ctx.needs_input_grad
        d_layers = LayerGradients(
            _or_zeros(d_image, (*size, 3)),
            _or_zeros(d_labels if needed[LABELS] else None, (*size, 0)),
            _or_zeros(d_alpha, size),
            _or_zeros(d_depth, size),
        )
        means, scales, quats = map(as_array, ctx.saved_tensors)
        gradients = list(unblend(ctx.state, means, scales, quats, d_layers).in_order())
        if d_labels is None:
            gradients[LABELS] = np.zeros(ctx.labels_shape, np.float32)
        wanted = zip(gradients, needed, strict=False)
        return *(torch.from_numpy(gradient) if need else None for gradient, need in wanted), None, None, None


def _or_zeros(gradient: Tensor | None, shape: tuple[int, ...]) -> Array:
    """That of a layer, of which torch says nothing where no loss looks at it."""
    return _zeros(shape) if gradient is None else as_array(gradient)


@lru_cache(maxsize=2)
def _zeros(shape: tuple[int, ...]) -> Array:
    """Made once for passes of one size; who gets them only reads. (Read-only arrays would be another type to Numba, and
    have kernels compiled anew.)"""
    return np.zeros(shape, np.float32)
