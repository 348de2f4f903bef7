"""The back end ``gsplat``, for tensors on a CUDA device: ``gsplat.rasterization`` with colour and depth as channels.

Labels are drawn by a second call with detached geometry, as their gradient must reach only the labels.

gsplat 1.5 differs from the other back ends in these points. It caps alpha at 0.999, not at 0.99 (1.6 caps at 0.99), so
an opaque Gaussian lets a tenth of the light through. It projects in float32, where the terms of a long thin Gaussian
cancel. It uses rounded boxes to decide what is ``visible``. The blur of 0.3 px^2, the clamp margins, the near plane,
the least alpha of 1/255 and the end of a pixel at 1e-4 agree.

This was tested with gsplat's own torch operators on a CPU; it has not yet been run on a GPU.
"""

from __future__ import annotations

from importlib import metadata
from typing import Any

import torch
from torch import Tensor

from .conventions import BLUR, Pinhole
from .rendering import GaussianSet, Rendering

OLDEST, TOO_NEW = (1, 5), (1, 7)
"""Versions (major, minor) of gsplat: the first that is known to have the call used here, and the first beyond those."""


def what_is_missing() -> str | None:
    """What to do before this back end can be used, or None."""
    wanted = "install it with: pip install 'gsplat>={}.{},<{}.{}'".format(*OLDEST, *TOO_NEW)
    try:
        version = metadata.version("gsplat")
    except metadata.PackageNotFoundError:
        return f"gsplat is not installed; {wanted}"
    major, minor = (int(part) for part in version.split(".")[:2])
    if OLDEST <= (major, minor) < TOO_NEW:
        return None
    age = "old" if (major, minor) < OLDEST else "new"
    return f"the installed version of gsplat, {version}, is too {age}; {wanted}"


def rasterize_gsplat(gaussians: GaussianSet, pinhole: Pinhole, top_k: int, want_means2d_grad: bool) -> Rendering:
    """``rasterize`` without ``top_k``, for float32 tensors. It requires that `what_is_missing` returns None."""
    assert top_k == 0, "the back end numba lists contributors"
    channels, alpha, about = _call(gaussians, gaussians.colours, pinhole, "RGB+D")
    visible = (about["radii"][0] > 0).all(-1)
    means2d = about["means2d"]
    leaf = torch.where(visible[:, None], means2d.detach()[0], 0.0)
    if want_means2d_grad:
        leaf.requires_grad_()
        means2d.register_hook(lambda gradient: setattr(leaf, "grad", gradient[0].contiguous()))
    labels = None
    if gaussians.labels is not None:
        labels = _call(gaussians.changed(Tensor.detach), gaussians.labels, pinhole, "RGB")[0]
    return Rendering(channels[..., :3], labels, alpha[..., 0], channels[..., 3], visible, leaf)


def _call(
    gaussians: GaussianSet, channels: Tensor, pinhole: Pinhole, mode: str
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """``channels`` [N, C] blended as [H, W, C], followed by the depth in ``mode`` "RGB+D"; alpha [H, W, 1]; and what
    gsplat returns about the Gaussians."""
    from gsplat import rasterization

    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal
    to_camera = torch.eye(4, dtype=torch.float64)
    to_camera[:3, :3] = torch.tensor(pinhole.rotation, dtype=torch.float64).reshape(3, 3)
    to_camera[:3, 3] = -to_camera[:3, :3] @ torch.tensor(pinhole.centre, dtype=torch.float64)
    intrinsics = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    drawn, alpha, about = rasterization(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=channels,
        viewmats=to_camera[None].to(channels),
        Ks=intrinsics[None].to(channels),
        width=pinhole.width,
        height=pinhole.height,
        near_plane=pinhole.near,
        eps2d=BLUR,
        packed=False,
        render_mode=mode,
    )
    return drawn[0], alpha[0], about
