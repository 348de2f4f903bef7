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


def object_classes(
    votes: NDArray[np.float64], class_ids: tuple[int, ...]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The class that each object was voted to be, int32 [objects + 1] (0 without votes; ties: lower id), and the
    winner's share of the votes float32 [objects + 1]."""
    ids = np.asarray(class_ids, np.int32)
    winner = votes.argmax(1)
    share = votes[np.arange(len(votes)), winner] / np.maximum(votes.sum(1), 1e-12)
    return np.where(votes.any(1), ids[winner], 0).astype(np.int32), share.astype(np.float32)


def label_by_object(
    cloud: SemanticPointCloud,
    object_of_point: NDArray[np.int32],
    votes: NDArray[np.float64],
    thing_ids: frozenset[int],
    least_share: float = 0.15,
) -> tuple[SemanticPointCloud, NDArray[np.int32]]:
    """The cloud with the points of each object that is a thing decided by the object's votes, float [objects + 1, C],
    and the object that each point then belongs to, int32 [N], 0 = none or stuff.

    A point that (nearly) no view calls by its object's class, less than ``least_share`` of its own votes, was swept
    into the object by an outline that took in its neighbour: it keeps its own label and belongs to no object. Stuff
    keeps its points' own labels too: an outline of stuff is wherever a view ends, so views have no common object to
    vote on. ``confidence`` of decided points becomes the winner's share of the object's votes.
    """
    class_of_object, share = object_classes(votes, cloud.class_ids)
    proposed = class_of_object[object_of_point]
    column = np.minimum(np.searchsorted(cloud.class_ids, proposed), len(cloud.class_ids) - 1)
    total = cloud.votes.sum(1)
    own = cloud.votes[np.arange(len(cloud)), column]
    decided = np.isin(proposed, sorted(thing_ids)) & ((total == 0) | (own >= least_share * total))
    relabelled = replace(
        cloud,
        class_id=np.where(decided, proposed, cloud.class_id).astype(np.int32),
        confidence=np.where(decided, share[object_of_point], cloud.confidence).astype(np.float32),
    )
    return relabelled, np.where(decided, object_of_point, 0).astype(np.int32)
