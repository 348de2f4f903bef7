"""Converts instance segments to points in space (Algorithm 1, lines 2 to 6), and matched segments to the consistent
instance masks M_match. Segments are eroded first: if a mask is one pixel too wide, depth of the background spoils its
box and the matching."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from ..machine.distinct_rows import distinct_rows
from ..scene import PanopticMask, View
from ..scene.pixels import numbered_labels
from .records import ObjectMask, SceneObject, fit_box


@dataclass(frozen=True)
class SegmentOptions:
    """Segments are eroded by the share ``erosion_share`` of the picture's width, rounded up to pixels, but at most by
    the share ``erosion_of_inradius`` of their inradius; with fewer than ``min_eroded`` points left, they are used
    whole. Segments of fewer than ``min_points`` are not matched. Points are thinned to one per voxel of ``voxel_size``
    metres."""

    voxel_size: float = 0.05
    erosion_share: float = 2 / 160
    erosion_of_inradius: float = 0.5
    min_eroded: int = 50
    min_points: int = 30


OUTLINE_ERROR = 0.004
"""Maximum error of an outline, as a fraction of the picture's longer side."""
OUTLINE_PART = 0.1
"""Parts smaller than this fraction of a mask's largest part get no outline."""


Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom as shares of the picture's width and height."""


def mask_extents(mask: PanopticMask) -> dict[int, tuple[float, Rectangle]]:
    """Return, by segment id, the share of the picture's pixels that a segment has, and the rectangle around it."""
    height, width = mask.ids.shape
    present, number = numbered_labels(mask.ids)
    count = np.bincount(number)
    rectangles = find_objects(number.reshape(mask.ids.shape) + 1)  # SciPy takes 0 as background
    return {
        int(segment): (
            float(pixels) / mask.ids.size,
            (across.start / width, down.start / height, across.stop / width, down.stop / height),
        )
        for segment, pixels, (down, across) in zip(present, count, rectangles, strict=True)
        if segment > 0
    }


def outline_of(mask: PanopticMask, segment: int, within: Rectangle = (0.0, 0.0, 1.0, 1.0)) -> str:
    """Return polygons around the larger parts of a segment, as text in the form of `MatchedSegment`; ``within``: the
    rectangle around the segment."""
    size = np.array(mask.ids.shape[::-1], np.float64)
    (left, top), (right, bottom) = np.rint(np.reshape(within, (2, 2)) * size).astype(int).tolist()
    inside = (mask.ids[top:bottom, left:right] == segment).astype(np.uint8)
    contours, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(left, top))
    areas = [cv2.contourArea(contour) for contour in contours]
    least = OUTLINE_PART * max(areas, default=0.0)
    polygons = []
    for contour in (each for each, area in zip(contours, areas, strict=True) if area >= least):
        corners = cv2.approxPolyDP(contour, OUTLINE_ERROR * float(size.max()), True)[:, 0]
        if len(corners) >= 3:
            polygons.append(" ".join(f"{x:.3f},{y:.3f}" for x, y in (corners + 0.5) / size))  # 0.5: pixel centres
    return ";".join(polygons)


def local_instances(view: View, class_ids: frozenset[int], options: SegmentOptions) -> list[SceneObject]:
    """Return I_local: the view's segments of these classes with enough points, by ascending segment id, each as an
    object with id 0. Their ``pixels`` are counted before erosion. Leaves out regions that may be several objects (a
    thing's class without an instance)."""
    points = view.camera.unproject(view.depth)
    margin = edge_distance(view.mask.ids)
    found = []
    for segment in sorted(view.mask.segments, key=lambda segment: segment.id):
        inside = (view.mask.ids == segment.id) & (view.depth > 0)
        pixels = int(inside.sum())
        if segment.class_id not in class_ids or segment.is_group or pixels < options.min_points:
            continue
        radius = min(
            float(math.ceil(options.erosion_share * inside.shape[1])),
            options.erosion_of_inradius * float(margin[inside].max()),
        )
        kept = inside & (margin > radius)
        kept = kept if int(kept.sum()) >= options.min_eroded else inside
        thinned = thin(points[kept], options.voxel_size)
        box, mask = fit_box(thinned, options.voxel_size), ObjectMask(view.name, segment, pixels)
        found.append(SceneObject(0, (mask,), segment.class_id, thinned, box))
    return found


def edge_distance(ids: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return each pixel's distance, in pixels, to the nearest pixel of another segment, float32 [H, W]; large if there
    is no other. The picture's border is no edge, since nothing bleeds in from there."""
    edge = np.zeros(ids.shape, bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    if not edge.any():
        return np.full(ids.shape, float(max(ids.shape)), np.float32)
    distance: NDArray[np.float32] = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5) + 1
    return distance


def thin(points: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """Return the mean of the points in each voxel of a side of ``voxel_size``, [n, 3] to [m, 3], metres, sorted."""
    _, voxel = distinct_rows(np.floor(points / voxel_size).astype(np.int64))
    count = np.bincount(voxel)
    return np.column_stack([np.bincount(voxel, points[:, axis]) / count for axis in range(3)])


def vote_instances(
    views: Sequence[View],
    point_of_pixel: Callable[[View], NDArray[np.int32]],
    points: int,
    instance_of_segment: Mapping[tuple[str, int], int],
) -> NDArray[np.int32]:
    """Return each point's instance by a vote of the views' segments, int32 [points], 0 = none; ties go to the lower id.
    In each view a point's pixels share one vote among their instances, so that near views do not outvote others.
    ``point_of_pixel`` returns the point nearest to each pixel's surface, int32 [H, W], -1 = none."""
    rows, ids, weights = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    for view in views:
        instance = instance_map(view, instance_of_segment)
        row = point_of_pixel(view)
        seen = row >= 0
        pixels = np.bincount(row[seen], minlength=points)
        voting = seen & (instance > 0)
        pairs, count = np.unique((row[voting].astype(np.int64) << 32) | instance[voting], return_counts=True)
        rows.append(pairs >> 32)
        ids.append(pairs & 0xFFFFFFFF)
        weights.append(count / pixels[pairs >> 32])
    pairs, inverse = np.unique((np.concatenate(rows) << 32) | np.concatenate(ids), return_inverse=True)
    total = np.bincount(inverse.reshape(-1), np.concatenate(weights), len(pairs))
    point, winner = pairs >> 32, pairs & 0xFFFFFFFF
    # Sorted by point, then by descending weight, then by ascending id: the first entry of a point wins.
    order = np.lexsort((winner, -np.round(total, 9), point))
    first = np.unique(point[order], return_index=True)[1]
    owner = np.zeros(points, np.int32)
    owner[point[order][first]] = winner[order][first]
    return owner


def instance_map(view: View, instance_of_segment: Mapping[tuple[str, int], int]) -> NDArray[np.int32]:
    """Return the instance, by ``instance_of_segment``, of each pixel of a view's mask, int32 [H, W], 0 = none."""
    present, inverse = np.unique(view.mask.ids, return_inverse=True)
    ids = np.array([instance_of_segment.get((view.name, int(segment)), 0) for segment in present], np.int32)
    return ids[inverse.reshape(view.mask.ids.shape)]
