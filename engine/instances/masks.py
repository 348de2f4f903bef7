"""Instance labels of points from matched segments, and the consistent instance masks M_match from these labels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import View

PointOfPixel = Callable[[View], NDArray[np.int32]]
"""Row in the cloud of the point nearest to each pixel's surface, int32 [H, W], -1 for none."""


def vote_instances(
    views: Sequence[View],
    point_of_pixel: PointOfPixel,
    points: int,
    instance_of_segment: Mapping[tuple[str, int], int],
) -> NDArray[np.int32]:
    """Instance of each point of the cloud by a vote of the views, int32 [points], 0 = none. Ties go to the lower id.

    In each view the instances that a point's pixels belong to share one vote, so that near views do not outvote others.
    """
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
    return _winner(np.concatenate(rows), np.concatenate(ids), np.concatenate(weights), points)


def instance_map(view: View, instance_of_segment: Mapping[tuple[str, int], int]) -> NDArray[np.int32]:
    """Matched instance of each pixel of a view's mask, int32 [H, W], 0 = none."""
    present, inverse = np.unique(view.mask.ids, return_inverse=True)
    ids = np.array([instance_of_segment.get((view.name, int(segment)), 0) for segment in present], np.int32)
    return ids[inverse.reshape(view.mask.ids.shape)]


def restrict_to_things(
    projected_instance: NDArray[np.int32], projected_class: NDArray[np.int32], thing_ids: Iterable[int]
) -> NDArray[np.int32]:
    """M_match: instances where the projected semantic mask shows a thing, int32 [H, W], 0 elsewhere."""
    thing = np.isin(projected_class, sorted(thing_ids))
    return np.where(thing, projected_instance, 0).astype(np.int32)


def _winner(
    rows: NDArray[np.int64], ids: NDArray[np.int64], weights: NDArray[np.float64], points: int
) -> NDArray[np.int32]:
    pairs, inverse = np.unique((rows << 32) | ids, return_inverse=True)
    total = np.bincount(inverse.reshape(-1), weights, len(pairs))
    row, instance = pairs >> 32, pairs & 0xFFFFFFFF
    # Sorted by row, then by descending weight, then by ascending id: the first entry of a row wins.
    order = np.lexsort((instance, -np.round(total, 9), row))
    first = np.unique(row[order], return_index=True)[1]
    winner = np.zeros(points, np.int32)
    winner[row[order][first]] = instance[order][first]
    return winner
