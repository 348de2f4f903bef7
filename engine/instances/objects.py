"""The objects that the views agree on: the class of each, by a vote of the views, and its points with their box.

The class vote is ours, beyond the paper. A detector is wrong about a whole object in a view far more often than about
a pixel: it takes the sofa for a bed. So the class of all points of an object is decided together. A view that resolves
the object better has more votes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..presets.preset import EvidenceKind
from ..scene import View, evidence
from .agreement import ViewPoints
from .oriented_box import fit_box
from .records import SceneObject

LEAST_SHARE = 0.4
"""Of the votes on an object, the share that its class needs. Masks that share a place and not a class are not one
object: most often they are of several things that a network could not tell apart."""


def vote_classes(
    views: Iterable[tuple[ViewPoints, NDArray[np.int32]]],
    object_of_point: NDArray[np.int32],
    objects: int,
    class_ids: tuple[int, ...],
    kind: EvidenceKind,
) -> NDArray[np.float64]:
    """Votes for the class of each of the ``objects`` 1.., float64 [objects + 1, C]; row 0, no object, is all 0.

    ``views``: what each view shows at the points it sees, and the class that it shows at each, int32 [n] (0 = none);
    ``object_of_point`` int32 [N], 0 = none. In each view an object's pixels share the votes of that ``kind``.
    """
    ids = np.asarray(class_ids)
    votes = np.zeros((objects + 1, len(ids)))
    for view, shown in views:
        column = np.minimum(np.searchsorted(ids, shown), len(ids) - 1)
        owner = object_of_point[view.row]
        voting = (owner > 0) & (ids[column] == shown)
        owner, column, pixels = owner[voting], column[voting], view.pixels[voting]
        seen = np.bincount(owner * len(ids) + column, pixels, votes.size).reshape(votes.shape)
        whole = np.maximum(seen.sum(1), 1e-12)
        resolution = np.bincount(owner, pixels * view.resolution[voting], len(votes)) / whole
        votes += seen * (evidence(kind, whole, resolution) / whole)[:, None]
    return votes


def object_classes(votes: NDArray[np.float64], class_ids: tuple[int, ...]) -> NDArray[np.int32]:
    """The class with the most votes for each object, int32 [objects + 1]. Ties go to the lower id. An object has no
    class, 0, without votes, and if the winner has less than ``LEAST_SHARE`` of them."""
    winner = np.asarray(class_ids, np.int32)[votes.argmax(1)]
    is_agreed = votes.max(1) >= LEAST_SHARE * votes.sum(1)
    return np.where(votes.any(1) & is_agreed, winner, 0).astype(np.int32)


def placed_objects(
    views: Sequence[View],
    objects: Sequence[SceneObject],
    xyz: NDArray[np.floating],
    object_of_point: NDArray[np.int32],
    min_thickness: float,
) -> list[SceneObject]:
    """The objects with their points, boxes, and the pixels of their masks. Each must own points.

    ``xyz`` [N, 3] metres are the cloud's points; ``object_of_point`` int32 [N] is the object that each belongs to (0 =
    none); ``min_thickness`` is the shortest side of a box in metres.
    """
    pixels = {
        (view.name, int(segment)): int(count)
        for view in views
        for segment, count in zip(*np.unique(view.mask.ids[view.depth > 0], return_counts=True), strict=True)
    }
    placed = []
    for one in objects:
        points = np.asarray(xyz[object_of_point == one.id], np.float64)
        masks = tuple(replace(mask, pixels=pixels.get(mask.key, 0)) for mask in one.masks)
        placed.append(replace(one, points=points, box=fit_box(points, min_thickness), masks=masks))
    return placed
