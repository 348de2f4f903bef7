"""Whether frames see the same surfaces, and agree about their places.

The cheapest test that poses, intrinsics and depth belong together: lift one frame's depth, project it into another and
compare with the depth there (equation "ProjectionEquation" of the paper, with a depth test).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..posed.camera import Camera

_TOLERANCE = 0.1
"""Metres, or 5 % of the depth if that is more: thumbnails of slanted surfaces are coarse."""
_NEXT = 3
_SPREAD = 24
_OVERLAPPING = 0.05
_LOOKED_AT = 0.2


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A frame's name, camera and depth, float32 [H, W] metres (0 = none), at a small size."""

    name: str
    camera: Camera
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class Overlap:
    """How well frames fit together.

    ``lonely`` names frames that share less than 5 % of their pixels with every frame they were compared with;
    ``overlaps`` is whether any two frames share more. ``in_view`` and ``agreement`` are medians over the pairs in which
    at least a fifth of one frame's points falls into the other's picture: the share that does, and the share of these
    with the depth expected there.
    """

    lonely: tuple[str, ...]
    overlaps: bool
    in_view: float
    agreement: float


def measure_overlap(thumbnails: Sequence[Thumbnail], tick: Callable[[], object] | None = None) -> Overlap:
    """Compare every frame with the next three, and 24 frames spread over the scene with each other.

    ``tick`` is called after each pair.
    """
    count = len(thumbnails)
    spread = np.unique(np.linspace(0, count - 1, min(count, _SPREAD)).round().astype(int)).tolist()
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _NEXT, count))}
    pairs |= {*combinations(spread, 2)}
    best = np.zeros(count)
    looks: list[tuple[float, float]] = []
    for i, j in sorted(pairs):
        inside, agreeing = _share_seen(thumbnails[i], thumbnails[j])
        best[i], best[j] = max(best[i], agreeing), max(best[j], agreeing)
        if inside >= _LOOKED_AT:
            looks.append((inside, agreeing / inside))
        if tick is not None:
            tick()
    medians = np.median(np.array(looks), axis=0) if looks else np.zeros(2)
    return Overlap(
        lonely=tuple(thumbnail.name for thumbnail, share in zip(thumbnails, best, strict=True) if share < _OVERLAPPING),
        overlaps=bool(best.max(initial=0.0) >= _OVERLAPPING),
        in_view=float(medians[0]),
        agreement=float(medians[1]),
    )


def _share_seen(one: Thumbnail, other: Thumbnail) -> tuple[float, float]:
    """The share of one frame's points that falls on depth of the other, and the share that agrees with it."""
    valid = one.depth > 0.0
    points = one.camera.unproject(one.depth)[valid]
    if not len(points):
        return 0.0, 0.0
    _, pixels, expected = other.camera.seen(points)
    columns, rows = pixels.astype(np.int64).T
    seen = other.depth[rows, columns]
    agrees = (seen > 0.0) & (np.abs(seen - expected) <= np.maximum(_TOLERANCE, 0.05 * expected))
    return float((seen > 0.0).sum() / len(points)), float(agrees.sum() / len(points))
