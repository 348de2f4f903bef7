"""The back end ``gsplat``, for tensors on a CUDA device: ``gsplat.rasterization`` with colour and depth as channels.

Labels are drawn by a second call with detached geometry, as their gradient must reach only the labels.

gsplat 1.5 differs from the other back ends in these points. It caps alpha at 0.999, not at 0.99 (1.6 caps at 0.99), so
an opaque Gaussian lets a tenth of the light through. It projects in float32, where the terms of a long thin Gaussian
cancel. It uses rounded boxes to decide what is ``visible``. The blur of 0.3 px^2, the clamp margins, the near plane,
the least alpha of 1/255 and the end of a pixel at 1e-4 agree. It sums gradients in any order, so no two lifts are the
same, bit for bit.

``docs/speed.md`` tells how it did on a GPU.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable
from importlib import metadata
from typing import Any

import torch
from torch import Tensor

from .conventions import BLUR, NEAR, Pinhole
from .rendering import GaussianSet, Rendering, Wanted

OLDEST, TOO_NEW = (1, 5), (1, 7)
"""Versions (major, minor) of gsplat: the first that is known to have the call used here, and the first beyond those."""

_CHANNELS = 32
"""Labels that gsplat blends in one go. Of some rows so many are drawn at a time, and only the rows are kept, so that a
picture of all labels is never in memory."""

log = logging.getLogger("plgs.raster")


def what_is_missing() -> str | None:
    """What to do before this back end can be used, or None."""
    wanted = "install it with: {} -m pip install 'gsplat>={}.{},<{}.{}'".format(sys.executable, *OLDEST, *TOO_NEW)
    try:
        version = metadata.version("gsplat")
    except metadata.PackageNotFoundError:
        return f"gsplat is not installed; {wanted}"
    major, minor = (int(part) for part in version.split(".")[:2])
    if OLDEST <= (major, minor) < TOO_NEW:
        return None
    age = "old" if (major, minor) < OLDEST else "new"
    return f"the installed version of gsplat, {version}, is too {age}; {wanted}"


def what_fails(device: str) -> str | None:
    """Draw one Gaussian on ``device``, and return the error's first line, or None. `what_is_missing` must return None.

    At the first use gsplat compiles its CUDA code, which takes minutes and can fail for many reasons: so this comes
    before a lift's work, not in the midst of it.
    """
    one = torch.ones(1, 4, device=device)
    gaussians = GaussianSet(one[:, :3], one[:, :3], one, one[:, 0], one[:, :3], None)
    camera = Pinhole((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0), (0.5, 0.5), 1, 1, NEAR)
    try:
        _call(gaussians, gaussians.colours, camera, "RGB")[0].sum().item()
    except Exception as error:  # whatever torch's builder, nvcc, the linker and the driver raise
        log.exception("gsplat cannot draw")
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return None


def rasterize_gsplat(gaussians: GaussianSet, pinhole: Pinhole, wanted: Wanted) -> Rendering:
    """``rasterize`` without ``top_k`` and surface, for float32 tensors. `what_is_missing` must return None."""
    assert wanted.top_k == 0, "the back end numba lists contributors"
    if not len(gaussians.means):
        return _nothing_drawn(gaussians, pinhole, wanted.means2d_grad)
    channels, alpha, about = _call(gaussians, gaussians.colours, pinhole, "RGB+D")
    means2d, above = about["means2d"], torch.tensor([0.0, pinhole.above]).to(gaussians.means)
    centres, radii = means2d.detach()[0] - above, about["radii"][0]
    down = centres[:, 1]
    visible = (radii > 0).all(-1) & (down + radii[:, 1] > 0) & (down - radii[:, 1] < pinhole.height)
    leaf = torch.where(visible[:, None], centres, 0.0)
    if wanted.means2d_grad:
        leaf.requires_grad_()
        means2d.register_hook(lambda gradient: setattr(leaf, "grad", gradient[0].contiguous()))
    labels = None
    if gaussians.labels is not None:
        still, whole = gaussians.changed(Tensor.detach), pinhole.height == pinhole.whole_height
        if whole:
            labels = _call(still, gaussians.labels, pinhole, "RGB")[0]
        else:  # copied, as rows that are a view would keep the whole picture
            parts = gaussians.labels.split(_CHANNELS, dim=1)
            labels = torch.cat([_call(still, part, pinhole, "RGB")[0].clone() for part in parts], dim=-1)
    return Rendering(channels[..., :3], labels, alpha[..., 0], channels[..., 3], visible, leaf)


def _nothing_drawn(gaussians: GaussianSet, pinhole: Pinhole, want_means2d_grad: bool) -> Rendering:
    """The rendering of no Gaussians. gsplat 1.5 divides by their number, which ends the process."""
    height, width, labels = pinhole.height, pinhole.width, gaussians.labels

    def blank(depends_on: Iterable[Tensor], *shape: int) -> Tensor:
        return torch.stack([each.sum() for each in depends_on]).sum().expand(shape).contiguous()

    image, alpha, depth = (blank(gaussians[:5], height, width, *more) for more in ((3,), (), ()))
    leaf = gaussians.means.detach()[:, :2].clone()
    if want_means2d_grad:
        leaf.requires_grad_().grad = torch.zeros_like(leaf)
    drawn_labels = None if labels is None else blank([labels], height, width, labels.shape[1])
    return Rendering(image, drawn_labels, alpha, depth, gaussians.opacities.detach() > 0, leaf)


def _call(
    gaussians: GaussianSet, channels: Tensor, pinhole: Pinhole, mode: str
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """``channels`` [N, C] blended as [H, W, C], followed by the depth in ``mode`` "RGB+D"; alpha [H, W, 1]; and what
    gsplat returns about the Gaussians, in pixels of the whole picture.

    Of some rows, the whole picture is drawn: gsplat takes the margins of the Jacobian's point from its height.
    """
    from gsplat import rasterization

    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal
    to_camera = torch.eye(4, dtype=torch.float64)
    to_camera[:3, :3] = torch.tensor(pinhole.rotation, dtype=torch.float64).reshape(3, 3)
    to_camera[:3, 3] = -to_camera[:3, :3] @ torch.tensor(pinhole.centre, dtype=torch.float64)
    intrinsics = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy + pinhole.above], [0.0, 0.0, 1.0]])
    drawn, alpha, about = rasterization(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=channels,
        viewmats=to_camera[None].to(channels),
        Ks=intrinsics[None].to(channels),
        width=pinhole.width,
        height=pinhole.whole_height or pinhole.height,
        near_plane=pinhole.near,
        eps2d=BLUR,
        packed=False,
        render_mode=mode,
    )
    rows = slice(pinhole.above, pinhole.above + pinhole.height)
    return drawn[0, rows], alpha[0, rows], about
