"""The back end ``gsplat``, for tensors on a CUDA device: ``gsplat.rasterization`` with colour and depth as channels.

Labels are blended from gsplat's list of the Gaussians that each pixel shows. Its own kernels would blend all channels
of all Gaussians of a tile, and their gradient would reach the geometry.

gsplat 1.5 differs from the other back ends in these points. It caps alpha at 0.999, not at 0.99 (1.6 caps at 0.99), so
an opaque Gaussian lets a tenth as much light through. It projects in float32, where the terms of a long thin Gaussian
cancel. It uses rounded boxes to decide what is ``visible``. It sums gradients in any order, so no two lifts are the
same, bit for bit. The blur of 0.3 px^2, the clamp margins, the near plane, the least alpha of 1/255 and the end of a
pixel at 1e-4 agree.

``docs/speed.md`` has measurements on a GPU."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from .conventions import BLUR, NEAR, Pinhole
from .rendering import GaussianSet, Rendering, Wanted

OLDEST, TOO_NEW = (1, 5), (1, 7)
"""gsplat versions (major, minor): the first known to have the call used here, and the first that is not tested."""

_TILE = 8
"""Pixels along a tile's side. With gsplat's 16, a small picture has too few tiles for a large GPU."""

log = logging.getLogger("plgs.raster")


def what_is_missing() -> str | None:
    """Return what the user must do before this back end can be used, or None if nothing is missing."""
    package = "gsplat>={}.{},<{}.{}".format(*OLDEST, *TOO_NEW)
    wanted = f"install it with: uv pip install --python {sys.executable} '{package}'"
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
    """Draw one Gaussian on ``device``; return the first line of the error, or None if it works. Call it before a lift's
    work begins: at first use gsplat compiles its CUDA code, which takes minutes and can fail in many ways.
    `what_is_missing` must return None."""
    one = torch.ones(1, 4, device=device)
    gaussians = GaussianSet(one[:, :3], one[:, :3], one, one[:, 0], one[:, :3], None)
    camera = Pinhole((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0), (0.5, 0.5), 1, 1, NEAR)
    try:
        _call(gaussians, camera)[0].sum().item()
    except Exception as error:  # whatever torch's builder, nvcc, the linker and the driver raise
        log.exception("gsplat cannot draw")
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return None


def rasterize_gsplat(gaussians: GaussianSet, pinhole: Pinhole, wanted: Wanted) -> Rendering:
    """Draw Gaussians as ``rasterize`` does, but by gsplat on a CUDA device: float32, without ``top_k`` and surface."""
    assert wanted.top_k == 0, "the back end numba lists contributors"
    if not len(gaussians.means):
        return _nothing_drawn(gaussians, pinhole, wanted.means2d_grad)
    channels, alpha, about = _call(gaussians, pinhole)
    means2d = about["means2d"]
    above = torch.tensor([0.0, pinhole.above]).to(gaussians.means, non_blocking=True)  # without a wait for the device
    centres, radii = means2d.detach()[0] - above, about["radii"][0]
    down = centres[:, 1]
    visible = (radii > 0).all(-1) & (down + radii[:, 1] > 0) & (down - radii[:, 1] < pinhole.height)
    leaf = torch.where(visible[:, None], centres, 0.0)
    if wanted.means2d_grad:
        leaf.requires_grad_()
        means2d.register_hook(lambda gradient: setattr(leaf, "grad", gradient[0].contiguous()))  # not a leaf
    labels = None if gaussians.labels is None else _blended_labels(gaussians.labels, pinhole, about)
    return Rendering(channels[..., :3], labels, alpha[..., 0], channels[..., 3], visible, leaf)


def _blended_labels(labels: Tensor, pinhole: Pinhole, about: dict[str, Any]) -> Tensor:
    """Blend ``labels`` [N, C] to a picture [H, W, C], by the projection and lists ``about`` that gsplat returned."""
    gaussian, starts, weights = _contributions(pinhole, about)
    first, pixels = pinhole.above * pinhole.width, pinhole.height * pinhole.width
    if pixels < len(starts):  # some rows of the picture
        starts = torch.cat([starts, starts.new_tensor([len(gaussian)])])[first : first + pixels + 1]
        shown = slice(*starts[[0, -1]].tolist())
        gaussian, weights, starts = gaussian[shown], weights[shown], starts[:-1] - starts[0]
    drawn = functional.embedding_bag(gaussian, labels, starts, mode="sum", per_sample_weights=weights)
    return drawn.view(pinhole.height, pinhole.width, -1)


@torch.no_grad()
def _contributions(pinhole: Pinhole, about: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians that each pixel of the whole picture shows, pixel by pixel, front to back: indices int64
    [A], where each pixel's begin int64 [P], and blending weights float32 [A]."""
    from gsplat import rasterize_to_indices_in_range

    width, height = pinhole.width, pinhole.whole_height or pinhole.height
    means2d, conics, opacities = about["means2d"], about["conics"], about["opacities"]
    lists = width, height, about["tile_size"], about["isect_offsets"], about["flatten_ids"]
    clear = means2d.new_ones(1, height, width)  # the transmittance in front of all
    gaussian, pixel, _ = rasterize_to_indices_in_range(0, 1 << 30, clear, means2d, conics, opacities, *lists)
    starts = torch.searchsorted(pixel, torch.arange(width * height, device=pixel.device))
    centre = torch.stack([pixel % width, pixel // width], dim=1) + 0.5
    across, down = (means2d[0].index_select(0, gaussian) - centre).unbind(1)
    a, b, c = conics[0].index_select(0, gaussian).unbind(1)
    fallen = torch.exp(-0.5 * (a * across * across + c * down * down) - b * across * down)
    alpha = (opacities[0].index_select(0, gaussian) * fallen).clamp_max(alpha_cap())
    dimmed = torch.log1p(-alpha.double())  # added up over all pixels, hence in double
    before = dimmed.cumsum(0) - dimmed
    light = torch.exp(before - before.index_select(0, starts.index_select(0, pixel)))
    return gaussian, starts, (alpha * light).float()


@cache
def alpha_cap() -> float:
    """Return the installed gsplat's largest alpha: 0.999 before version 1.6, then 0.99."""
    return 0.999 if metadata.version("gsplat").startswith("1.5.") else 0.99


def _nothing_drawn(gaussians: GaussianSet, pinhole: Pinhole, want_means2d_grad: bool) -> Rendering:
    """Return a black rendering, for no Gaussians: gsplat 1.5 would divide by their number and crash the process."""
    height, width, labels = pinhole.height, pinhole.width, gaussians.labels

    def blank(depends_on: Iterable[Tensor], *shape: int) -> Tensor:
        return torch.stack([each.sum() for each in depends_on]).sum().expand(shape).contiguous()  # 0, with a graph

    image, alpha, depth = (blank(gaussians[:5], height, width, *more) for more in ((3,), (), ()))
    leaf = gaussians.means.detach()[:, :2].clone()
    if want_means2d_grad:
        leaf.requires_grad_().grad = torch.zeros_like(leaf)  # no backward pass reaches it
    drawn_labels = None if labels is None else blank([labels], height, width, labels.shape[1])
    return Rendering(image, drawn_labels, alpha, depth, gaussians.opacities.detach() > 0, leaf)


def _call(gaussians: GaussianSet, pinhole: Pinhole) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Call gsplat; return colour and depth [H, W, 4], alpha [H, W, 1], and gsplat's facts about the Gaussians. It draws
    the whole picture, even if only some rows are wanted, as the Jacobian's clamp margins depend on its size."""
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
        colors=gaussians.colours,
        viewmats=to_camera[None].float().to(gaussians.means, non_blocking=True),
        Ks=intrinsics[None].to(gaussians.means, non_blocking=True),
        width=pinhole.width,
        height=pinhole.whole_height or pinhole.height,
        near_plane=pinhole.near,
        eps2d=BLUR,
        packed=False,  # a row for every Gaussian, also for those that are not visible
        render_mode="RGB+D",  # D is not divided by alpha, as `Rendering` wants it (ED would be)
        tile_size=_TILE,
    )
    rows = slice(pinhole.above, pinhole.above + pinhole.height)
    return drawn[0, rows], alpha[0, rows], about
