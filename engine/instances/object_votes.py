"""One class for each object, by a vote of the views (ours, beyond the paper).

A detector is wrong about an object in a view far more often than about a pixel: it takes the whole sofa for a
bed. So the points of an object are decided together. Each view votes with the square root of the pixels it
has of the object: a near view, which sees it larger and better, counts for more, but cannot outvote the rest
by its mass of pixels.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

ViewVotes = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
"""Of one view: rows of the cloud int32 [n], the class it shows there int32 [n] (0 = none), the pixels int32
[n].
"""


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


def object_classes(
    votes: NDArray[np.float64], class_ids: tuple[int, ...]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The class that each object was voted to be, int32 [objects + 1] (0 without votes; ties: lower id), and the
    winner's share of the votes float32 [objects + 1]."""
    ids = np.asarray(class_ids, np.int32)
    winner = votes.argmax(1)
    share = votes[np.arange(len(votes)), winner] / np.maximum(votes.sum(1), 1e-12)
    return np.where(votes.any(1), ids[winner], 0).astype(np.int32), share.astype(np.float32)
