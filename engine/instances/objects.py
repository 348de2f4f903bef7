"""What the objects are that views agree on: the class of each, by a vote of the views, and the instance with its box.

The class is ours, beyond the paper. A detector is wrong about a whole object in a view far more often than about a
pixel: it takes the sofa for a bed. So the points of an object are decided together. Each view votes with the square
root of the pixels it has of the object. A near view, which sees it larger and better, counts for more, but cannot
outvote the others by its mass of pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import View
from .consensus import MemberMask
from .matching import Evidence, GlobalInstance
from .oriented_box import fit_box

ViewVotes = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
"""What one view shows: rows of the cloud int32 [n], the class at each int32 [n] (0 = none), its pixels int32 [n]."""


def vote_classes(
    views: Iterable[ViewVotes], object_of_point: NDArray[np.int32], objects: int, class_ids: tuple[int, ...]
) -> NDArray[np.float64]:
    """Votes for the class of each of the ``objects`` 1.., float64 [objects + 1, C]; row 0, no object, is all 0.

    ``object_of_point`` int32 [N], 0 = none. In each view an object's pixels share sqrt(pixels) votes.
    """
    ids = np.asarray(class_ids)
    votes = np.zeros((objects + 1, len(ids)))
    for row, shown, pixels in views:
        column = np.minimum(np.searchsorted(ids, shown), len(ids) - 1)
        owner = object_of_point[row]
        voting = (owner > 0) & (ids[column] == shown)
        seen = np.bincount(owner[voting] * len(ids) + column[voting], pixels[voting], votes.size).reshape(votes.shape)
        votes += seen / np.sqrt(np.maximum(seen.sum(1, keepdims=True), 1.0))
    return votes


def object_classes(votes: NDArray[np.float64], class_ids: tuple[int, ...]) -> NDArray[np.int32]:
    """The class with the most votes for each object, int32 [objects + 1], 0 without votes. Ties go to the lower id."""
    winner = np.asarray(class_ids, np.int32)[votes.argmax(1)]
    return np.where(votes.any(1), winner, 0).astype(np.int32)


def object_instances(
    views: Sequence[View],
    objects: Sequence[tuple[Sequence[MemberMask], int]],
    xyz: NDArray[np.floating],
    object_of_point: NDArray[np.int32],
    min_thickness: float,
) -> list[GlobalInstance]:
    """The ``objects`` 1.. (the masks of each, and its class) as instances with boxes. Each owns points.

    ``xyz`` [N, 3] metres are the cloud's points; ``object_of_point`` int32 [N] is the object that each belongs to (0 =
    none); ``min_thickness`` is the shortest side of a box in metres.
    """
    pixels = {
        (view.name, int(segment)): int(count)
        for view in views
        for segment, count in zip(*np.unique(view.mask.ids[view.depth > 0], return_counts=True), strict=True)
    }
    instances: list[GlobalInstance] = []
    for number, (masks, class_id) in enumerate(objects, start=1):
        points = np.asarray(xyz[object_of_point == number], np.float64)
        evidence = tuple(
            Evidence.of(
                mask.frame, mask.segment, pixels.get((mask.frame, mask.segment.id), 0), agreement=mask.agreement
            )
            for mask in masks
        )
        instances.append(GlobalInstance(number, points, fit_box(points, min_thickness), evidence, class_id))
    return instances
