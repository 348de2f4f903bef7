"""The back end ``numba``: both passes as a ``torch.autograd.Function``, compiled when first needed."""

from __future__ import annotations

import logging
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..machine import memory
from ..machine.bell import listen, new_bell
from ..machine.crew import worker_count
from ..machine.warm_up import WarmUp
from .backward_pass import LayerGradients, unblend
from .compile_backward import compile_backward
from .conventions import NEAR, View
from .forward_pass import as_array, blend, top_contributors
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
    centres = memory.empty_tensor((means.shape[0], 2)).requires_grad_(want_means2d_grad)
    visible = torch.empty(means.shape[0], dtype=torch.bool)
    inputs = (means, scales, quats, opacities, colours, labels, centres)
    differentiable = any(tensor is not None and tensor.requires_grad for tensor in inputs)
    _warm_up(choose_kernels()).forward(torch.is_grad_enabled() and differentiable)
    image, labels_out, alpha, depth, *top = _Blend.apply(*inputs, view, visible, top_k)
    return Rendering(
        image=image,
        labels=labels_out if labels is not None else None,
        alpha=alpha,
        depth=depth,
        visible=visible,
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
    view = View(np.eye(3), np.array([0.0, 0.0, -3.0]), (1.0, 1.0), (0.5, 0.5), 1, 1, NEAR)
    _Blend.apply(*inputs, view, torch.empty(1, dtype=torch.bool), 0)
    listen(new_bell(), heard=1, looks=1)  # with one Gaussian nobody had to wait


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
        visible: Tensor,
        top_k: int,
    ) -> tuple[Tensor, ...]:
        gaussians = [as_array(tensor) for tensor in (means, scales, quats, opacities, colours)]
        features = as_array(labels) if labels is not None else np.empty((means.shape[0], 0), np.float32)
        layers, state = blend(choose_kernels(), gaussians, features, view, as_array(centres), visible.numpy())
        top: tuple[Tensor, ...] = ()
        if top_k:
            top = top_contributors(state, (view.height, view.width, top_k))
            ctx.mark_non_differentiable(*top)
        ctx.save_for_backward(means, scales, quats)
        ctx.state = state
        ctx.has_labels = labels is not None
        return layers.image, layers.labels, layers.alpha, layers.depth, *top

    @staticmethod
    def backward(
        ctx: Any, d_image: Tensor, d_labels: Tensor, d_alpha: Tensor, d_depth: Tensor, *_: Tensor
    ) -> tuple[Tensor | None, ...]:
        _warm_up(ctx.state.kernels).backward()
        wants_labels = ctx.has_labels and ctx.needs_input_grad[LABELS]
        own_labels = as_array(d_labels) if wants_labels else np.empty((*d_alpha.shape, 0), np.float32)
        d_layers = LayerGradients(as_array(d_image), own_labels, as_array(d_alpha), as_array(d_depth))
        means, scales, quats = map(as_array, ctx.saved_tensors)
        gradients = unblend(ctx.state, means, scales, quats, d_layers).in_order()
        wanted = zip(gradients, ctx.needs_input_grad, strict=False)
        return *(gradient if need else None for gradient, need in wanted), None, None, None
