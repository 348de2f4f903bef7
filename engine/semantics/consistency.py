"""Consistency-enhanced 2D masks: keeps the pixels with whose label neighbouring views agree. Also makes pseudo labels
for self-training.

Paper, section "Consistency-enhanced 2D Mask Generation": q(u) is the product of 1{s_u = s_u'} over the pixels u' that
the neighbouring views warp to u. The warp is backward here: each pixel is unprojected by its own depth and looked up in
each neighbour, which leaves no holes. A depth test (ours; the paper has none) skips surfaces that the neighbour does
not see, so that an occluder's label cannot veto a correct pixel."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..scene import VOID, PanopticMask, View

SPARSE_OVERLAP = 0.5
"""Median overlap with the next view below which views are too sparse to compare their labels."""
OVERLAP_STRIDE = 8
"""The step in rows and columns between the pixels that measure the overlap of two views."""


@dataclass(frozen=True)
class ConsistencyOptions:
    """How views are compared. ``neighbours``: N_w of the paper, half before and half after in recording order; 0 skips
    the comparison. A pixel is kept if at least the share ``agreement`` of the neighbours that see its surface agree:
    1.0 is the paper's product, 0.75 keeps more at a similar error. A pixel that no neighbour sees is kept (the empty
    product is 1). The depth test allows max(``depth_tolerance_m``, ``depth_tolerance_share`` * z) metres."""

    neighbours: int = 8
    agreement: float = 1.0
    depth_tolerance_m: float = 0.05
    depth_tolerance_share: float = 0.02


def neighbour_indices(index: int, count: int, neighbours: int) -> list[int]:
    """Return the indices of the views to compare with view ``index`` of ``count``: the nearest in recording order, as
    evenly on both sides as possible."""
    size = min(neighbours + 1, count)
    start = min(max(index - neighbours // 2, 0), count - size)
    return [i for i in range(start, start + size) if i != index]


def consistency_masks(views: Sequence[View], options: ConsistencyOptions) -> Iterator[NDArray[np.bool_]]:
    """Yield q(u) of each view: bool [H, W], True where the pixel's label is consistent; void never is."""
    window: dict[int, NDArray[np.int32]] = {}
    for index, view in enumerate(views):
        others = neighbour_indices(index, len(views), options.neighbours)
        wanted = [index, *others]
        window = {i: window[i] if i in window else views[i].mask.class_map() for i in wanted}
        agree, seen = _compare(view, window[index], [(views[i], window[i]) for i in others], options)
        kept = agree >= options.agreement * seen - 1e-9  # a product of floats may be a little too large
        # Without depth nothing was compared, and no pixel can be unprojected either.
        yield kept & (window[index] != VOID) & (view.depth > 0)


def view_overlap(view: View, other: View, options: ConsistencyOptions) -> float:
    """Return the share of a view's pixels with depth whose surface the ``other`` view sees, 0 to 1."""
    stride, sampled = OVERLAP_STRIDE, np.zeros_like(view.depth)
    sampled[::stride, ::stride] = view.depth[::stride, ::stride]
    everywhere, there = np.ones(view.depth.shape, np.int32), np.ones(other.depth.shape, np.int32)
    _, seen = _compare(replace(view, depth=sampled), everywhere, [(other, there)], options)
    return float(seen.sum()) / max(int((sampled > 0).sum()), 1)


def views_are_sparse(views: Sequence[View], options: ConsistencyOptions) -> bool:
    """Whether views overlap too little to compare: the median overlap with the next view is below SPARSE_OVERLAP."""
    if len(views) < 2:
        return True
    overlaps = [view_overlap(view, other, options) for view, other in itertools.pairwise(views)]
    return float(np.median(overlaps)) < SPARSE_OVERLAP


class LabelledDepth(NamedTuple):
    """A view's arrays for a kernel: ``depth`` float32 [H, W] metres, ``label`` int32 [H, W], ``intrinsics`` pixels."""

    depth: NDArray[np.float32]
    label: NDArray[np.int32]
    intrinsics: tuple[float, float, float, float]


def _compare(
    view: View, label: NDArray[np.int32], others: Sequence[tuple[View, NDArray[np.int32]]], options: ConsistencyOptions
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return how many of the ``others`` (views and their labels) agree with each pixel's label, and how many see it
    labelled: int32 [H, W] each."""
    agree = np.zeros(view.depth.shape, np.int32)
    seen = np.zeros(view.depth.shape, np.int32)
    share, metres = options.depth_tolerance_share, options.depth_tolerance_m
    here = view.camera
    for other, other_label in others:
        there = other.camera
        relative = there.world_to_camera @ here.camera_to_world
        one = LabelledDepth(view.depth, label, (here.fx, here.fy, here.cx, here.cy))
        two = LabelledDepth(other.depth, other_label, (there.fx, there.fy, there.cx, there.cy))
        _warp_and_compare(one, two, relative, float(metres), float(share), agree, seen)
    return agree, seen


@njit(cache=True, nogil=True)
def _warp_and_compare(
    one: LabelledDepth, two: LabelledDepth, relative: Any, metres: Any, share: Any, agree: Any, seen: Any
) -> None:
    """Warp view ``one`` to ``two`` by depth, w(u) of the paper, compare labels, and add to ``agree`` and ``seen``.
    ``relative`` [4, 4] takes points from ``one``'s camera to ``two``'s; ``metres`` or ``share`` is the tolerance."""
    fx, fy, cx, cy = one.intrinsics
    gx, gy, hx, hy = two.intrinsics
    depth, label = one.depth, one.label
    height, width = two.depth.shape
    for j in range(depth.shape[0]):
        for i in range(depth.shape[1]):
            d = depth[j, i]
            if d <= 0 or label[j, i] == 0:
                continue
            x, y = (i + 0.5 - cx) / fx * d, (j + 0.5 - cy) / fy * d
            z = relative[2, 0] * x + relative[2, 1] * y + relative[2, 2] * d + relative[2, 3]
            if z <= 1e-6:
                continue
            u = (relative[0, 0] * x + relative[0, 1] * y + relative[0, 2] * d + relative[0, 3]) / z * gx + hx
            v = (relative[1, 0] * x + relative[1, 1] * y + relative[1, 2] * d + relative[1, 3]) / z * gy + hy
            if not (0 <= u < width and 0 <= v < height):
                continue
            s, t = int(u), int(v)
            other = two.label[t, s]
            if other == 0:
                continue
            there = two.depth[t, s]
            if there <= 0 or abs(z - there) > max(metres, share * z):
                continue
            seen[j, i] += 1
            if other == label[j, i]:
                agree[j, i] += 1


def regions(mask: PanopticMask) -> NDArray[np.int32]:
    """Return {R_m} of the paper, connected regions of equal class (4 neighbours): int32 [H, W], from 1, 0 = void."""
    classes = mask.class_map()
    result = np.zeros(classes.shape, np.int32)
    count = 0
    for value in np.unique(classes[classes != VOID]):
        number, parts = cv2.connectedComponents((classes == value).astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
        np.copyto(result, parts + count, where=parts > 0)
        count += number - 1  # without OpenCV's background
    return result


def pseudo_labels(mask: PanopticMask, rendered_class: NDArray[np.int32], least_area: int) -> NDArray[np.int32]:
    """Return s_pse of the paper, int32 [H, W], 0 = no supervision: each region takes the class that most of its pixels
    have in ``rendered_class`` int32 [H, W], where 0 (nothing rendered) has no vote. Ties go to the lower id. Regions of
    fewer than ``least_area`` pixels keep their rendered classes; void regions stay 0."""
    region = regions(mask)
    count = int(region.max(initial=0)) + 1
    ids, column = np.unique(rendered_class, return_inverse=True)
    votes = np.bincount(region.reshape(-1) * len(ids) + column.reshape(-1), minlength=count * len(ids))
    votes = votes.reshape(count, len(ids))
    area = votes.sum(1)
    votes[:, ids == VOID] = 0
    winner = np.where(votes.any(1), ids[votes.argmax(1)], VOID).astype(np.int32)
    winner[0] = VOID  # region 0 is void
    small = (area < least_area)[region] & (region > 0)
    return np.where(small, rendered_class, winner[region]).astype(np.int32)
