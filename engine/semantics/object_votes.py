"""One class for each object, by a vote of the views (ours, beyond the paper).

A detector is wrong about an object in a view far more often than about a pixel: it takes the whole sofa for a
bed. So the points of an object are decided together. Each view votes with the square root of the pixels it
has of the object: a near view, which sees it larger and better, counts for more, but cannot outvote the rest
by its mass of pixels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .point_cloud import SemanticPointCloud

ViewVotes = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
"""Of one view: rows of the cloud int32 [n], the class it shows there int32 [n] (0 = none), the pixels int32
[n].
"""


def vote_classes(
    views: Iterable[ViewVotes], object_of_point: NDArray[np.int32], class_ids: tuple[int, ...]
) -> NDArray[np.float64]:
    """Votes for the class of each object, float64 [objects + 1, C]; row 0, no object, is all 0.

    ``object_of_point`` int32 [N], 0 = none. In each view an object's pixels share sqrt(pixels) votes.
    """
    ids = np.asarray(class_ids)
    votes = np.zeros((int(object_of_point.max(initial=0)) + 1, len(ids)))
    for row, shown, pixels in views:
        column = np.minimum(np.searchsorted(ids, shown), len(ids) - 1)
        owner = object_of_point[row]
        voting = (owner > 0) & (ids[column] == shown)
        seen = np.bincount(owner[voting] * len(ids) + column[voting], pixels[voting], votes.size).reshape(votes.shape)
        votes += seen / np.sqrt(np.maximum(seen.sum(1, keepdims=True), 1.0))
    return votes


def label_by_object(
    cloud: SemanticPointCloud,
    object_of_point: NDArray[np.int32],
    votes: NDArray[np.float64],
    thing_ids: frozenset[int],
) -> SemanticPointCloud:
    """The cloud with the points of each object that is a thing decided by the object's votes, float [objects
    + 1, C].

    Stuff keeps its points' own labels: an outline of stuff is wherever a view ends, so views have no common
    object to vote on. ``confidence`` becomes the winner's share of the object's votes.
    """
    ids = np.asarray(cloud.class_ids, np.int32)
    winner = votes.argmax(1)
    class_of_object = np.where(votes.any(1), ids[winner], 0).astype(np.int32)
    share = votes[np.arange(len(votes)), winner] / np.maximum(votes.sum(1), 1e-12)
    decided = np.isin(class_of_object, sorted(thing_ids))[object_of_point]
    return replace(
        cloud,
        class_id=np.where(decided, class_of_object[object_of_point], cloud.class_id).astype(np.int32),
        confidence=np.where(decided, share[object_of_point], cloud.confidence).astype(np.float32),
    )
