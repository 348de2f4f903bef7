"""The back end ``gsplat``: the same picture by gsplat's own operators, for tensors on a CUDA device."""

from __future__ import annotations

import importlib.util

import torch
from torch import Tensor

from .conventions import BLUR, View
from .rendering import Rendering


def is_installed() -> bool:
    return importlib.util.find_spec("gsplat") is not None


def rasterize_gsplat(
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
    """As ``rasterize``. Labels are drawn by a second call that sees detached geometry and opacities.

    Raises ``ValueError`` for ``top_k`` > 0, which gsplat does not offer, ``ImportError`` when gsplat is not
    installed.
    """
    if top_k:
        raise ValueError(
            "the back end gsplat has no top_k; choose the back end numba, with tensors on the CPU"
        )
    from gsplat import rasterization

    world_to_camera = torch.eye(4, dtype=means.dtype, device=means.device)
    rotation = torch.as_tensor(view.rotation, dtype=means.dtype, device=means.device)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ torch.as_tensor(view.centre, dtype=means.dtype, device=means.device)
    intrinsics = torch.eye(3, dtype=means.dtype, device=means.device)
    intrinsics[0, 0], intrinsics[1, 1] = view.focal
    intrinsics[0, 2], intrinsics[1, 2] = view.principal
    camera = {
        "viewmats": world_to_camera[None],
        "Ks": intrinsics[None],
        "width": view.width,
        "height": view.height,
        "near_plane": view.near,
        "eps2d": BLUR,
        "packed": False,
        "rasterize_mode": "classic",
    }
    opacities = opacities.clamp(min=0.0)
    drawn, alpha, meta = rasterization(
        means, quats, scales, opacities, colours, render_mode="RGB+D", **camera
    )
    handle = meta["means2d"].detach()[0].clone().requires_grad_(want_means2d_grad)
    if want_means2d_grad:
        meta["means2d"].register_hook(lambda gradient: _accumulate(handle, gradient[0]))
    drawn_labels = None
    if labels is not None:
        geometry = (tensor.detach() for tensor in (means, quats, scales, opacities))
        drawn_labels = rasterization(*geometry, labels, render_mode="RGB", **camera)[0][0]
    radii = meta["radii"][0]
    return Rendering(
        image=drawn[0, :, :, :3],
        labels=drawn_labels,
        alpha=alpha[0, :, :, 0],
        depth=drawn[0, :, :, 3],
        visible=(radii > 0).all(-1) if radii.ndim == 2 else radii > 0,
        means2d=handle,
    )


def _accumulate(handle: Tensor, gradient: Tensor) -> None:
    handle.grad = gradient.clone() if handle.grad is None else handle.grad + gradient
