"""The back end ``gsplat``, for tensors on a CUDA device: gsplat finds and sorts what lies on each tile, torch blends.

gsplat's one call, ``rasterization``, cannot give the semantics of ``rasterize``. In its version 1.5:

- it caps alpha at 0.999, not at 0.99 (1.6 caps at 0.99), so what an opaque Gaussian lets through is a tenth;
- it projects, inverts the 2D covariance and evaluates its quadratic form in float32, where the terms of a long thin
  Gaussian cancel: for the tests' needles its inverse is off by up to 7 %;
- it has no top_k (1.6 has), and its weights are never seen, so labels with detached weights cost a second pass.

The rest agrees: 0.3 px^2 blur, clamp margins, the near plane (only a z equal to it differs), alphas skipped below
1/255, a pixel's end at 1e-4, boxes by opacity of at most 3.33 standard deviations (all that can reach 1/255).

So two of its operators are used here, ``isect_tiles`` and ``isect_offset_encode``: they list the Gaussians of every
tile by depth as float32, ties by index, which is our order. They are handed boxes of whole pixels, which float32 holds
exactly. The projection (float64) is the reference's, the blending is in ``blending.torch_tiles``. Both are torch and
run where the tensors are. Against gsplat's compiled blending that costs speed.

Checked on a CPU, with gsplat 1.5.3's own torch counterparts of the two operators; not yet run on a GPU.
"""

from __future__ import annotations

from importlib import metadata

import torch
from torch import Tensor

from .blending.torch_tiles import Splats, TileLists, blend_in_torch
from .conventions import Pinhole
from .records import TILE
from .reference import footprint_boxes, project
from .rendering import Rendering

OLDEST, TOO_NEW = (1, 5), (1, 7)
"""Versions (major, minor) of gsplat: the first whose operators were read and found to be as used here, and the first
of those that were not."""


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
    return f"the gsplat that is installed, {version}, is too {age}; {wanted}"


def rasterize_gsplat(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    colours: Tensor,
    labels: Tensor | None,
    pinhole: Pinhole,
    top_k: int,
    want_means2d_grad: bool,
) -> Rendering:
    """As ``rasterize``, for float32 or float64 tensors; needs a gsplat in which nothing is missing."""
    centres, covariances, depths = project(means.double(), scales.double(), quats.double(), pinhole)
    first, last, visible = footprint_boxes(
        centres.detach(), covariances.detach(), depths.detach(), opacities.detach().double(), pinhole
    )
    shown = torch.nonzero(visible)[:, 0]
    handle = torch.where(visible[:, None], centres.detach(), 0.0).to(means.dtype)
    handle.requires_grad_(want_means2d_grad)
    # the value of the centres, the gradient of both
    centres = centres + (handle - handle.detach())
    lists = list_by_gsplat(first[shown], last[shown], depths.detach()[shown].float(), pinhole)
    features = torch.cat([colours, torch.ones_like(colours[:, :1]), depths[:, None].to(means.dtype)], -1)
    labelled = colours.new_zeros(len(colours), 0) if labels is None else labels
    splats = Splats(centres[shown], covariances[shown], opacities[shown], features[shown], labelled[shown])
    blended = blend_in_torch(splats, lists, top_k)
    drawn = blended.top_ids >= 0
    top_indices = torch.where(drawn, shown[blended.top_ids.clamp(min=0)] if len(shown) else -1, -1)
    return Rendering(
        image=blended.features[:, :, :3],
        labels=None if labels is None else blended.labels,
        alpha=blended.features[:, :, 3],
        depth=blended.features[:, :, 4],
        visible=visible,
        means2d=handle,
        top_indices=top_indices.to(torch.int32) if top_k else None,
        top_weights=blended.top_weights if top_k else None,
    )


def list_by_gsplat(first: Tensor, last: Tensor, depths: Tensor, pinhole: Pinhole) -> TileLists:
    """What touches which tile, front to back, by gsplat's operators.

    ``first`` and ``last`` [V, 2]: the (column, row) of the box's corner pixels, within the image; ``depths`` float32
    [V], positive. The only place that calls gsplat.
    """
    from gsplat import isect_offset_encode, isect_tiles

    columns, rows = -(-pinhole.width // TILE), -(-pinhole.height // TILE)
    if not len(depths):
        none = torch.zeros(columns * rows + 1, dtype=torch.int64, device=depths.device)
        return TileLists(none[:0], none, pinhole.width, pinhole.height)
    # A box is the middle and an integer radius; one that reaches a pixel too far is no harm, as the blending decides.
    radii = torch.ceil((last - first + 1.0) / 2.0)
    middles = first + radii
    _, keys, ids = isect_tiles(middles[None].float(), radii[None].to(torch.int32), depths[None], TILE, columns, rows)
    starts = isect_offset_encode(keys, 1, columns, rows).flatten().long()
    end = torch.full((1,), len(ids), dtype=torch.int64, device=ids.device)
    return TileLists(ids.long(), torch.cat([starts, end]), pinhole.width, pinhole.height)
