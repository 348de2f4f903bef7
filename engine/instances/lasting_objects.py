"""Matches a lift's objects with those of an earlier lift of the scene, by the overlap of their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ..machine.distinct_rows import distinct_rows

CELL = 0.08
"""Side in metres of the cells in which points are compared, as lifts with other presets have other spacings."""
LEAST_IOU = 0.2
"""Two objects are the same if their cells have at least this IoU. More frames may show twice as much of an object."""
MOST_OF_IT = 0.5
"""An object is a part of another if at least this fraction of its cells lies within it."""


@dataclass(frozen=True, eq=False)
class ObjectOverlap:
    """The overlap of A old and B new objects, in grid cells. ``common`` int64 [A, B]: cells with points of old and new;
    ``old_cells`` int64 [A], ``new_cells`` int64 [B]: all cells with points of each; ids in the same order."""

    old_ids: NDArray[np.int64]
    new_ids: NDArray[np.int64]
    old_cells: NDArray[np.int64]
    new_cells: NDArray[np.int64]
    common: NDArray[np.int64]

    @property
    def iou(self) -> NDArray[np.float64]:
        """The intersection over union of each old and each new object, counted in cells, float64 [A, B]."""
        union = self.old_cells[:, None] + self.new_cells[None, :] - self.common
        return self.common / np.maximum(union, 1)


@dataclass(frozen=True)
class LastingObjects:
    """Which objects lasted, as maps of ids. ``old_of``: new object -> the same old object. ``parts``: any other new
    object -> the old object that it lies within. ``merged``: old object that is gone -> the new object that it lies
    within."""

    old_of: dict[int, int]
    parts: dict[int, int]
    merged: dict[int, int]


def object_overlap(
    old_xyz: NDArray[np.floating],
    old_id: NDArray[np.integer],
    new_xyz: NDArray[np.floating],
    new_id: NDArray[np.integer],
) -> ObjectOverlap:
    """Return the overlap of old and new objects, by points [N, 3] and [M, 3], metres, and ids [N], [M] (0 = none)."""
    cells = np.floor(np.concatenate([old_xyz[old_id > 0], new_xyz[new_id > 0]]) / CELL).astype(np.int64)
    _, cell = distinct_rows(cells)
    count = int((old_id > 0).sum())
    old_ids, old_of, old_cell = _distinct(old_id[old_id > 0], cell[:count])
    new_ids, new_of, new_cell = _distinct(new_id[new_id > 0], cell[count:])
    size = int(cell.max(initial=-1)) + 1
    common = np.zeros((len(old_ids), len(new_ids)), np.int64)
    # A cell may hold points of several objects, so each of its old objects is paired with each of its new ones.
    starts = np.searchsorted(new_cell, np.arange(size + 1))
    for old, at in zip(old_of.tolist(), old_cell.tolist(), strict=True):
        common[old, new_of[starts[at] : starts[at + 1]]] += 1
    old_cells = np.bincount(old_of, minlength=len(old_ids))
    return ObjectOverlap(old_ids, new_ids, old_cells, np.bincount(new_of, minlength=len(new_ids)), common)


def lasting_objects(overlap: ObjectOverlap) -> LastingObjects:
    """Assign new objects to old objects, one to one, with the largest sum of IoU; no pair below LEAST_IOU."""
    iou = overlap.iou
    rows, columns = linear_sum_assignment(-np.where(iou >= LEAST_IOU, iou, 0.0))  # weak ones must not displace others
    pairs = [(row, column) for row, column in zip(rows, columns, strict=True) if iou[row, column] >= LEAST_IOU]
    old_of = {int(overlap.new_ids[column]): int(overlap.old_ids[row]) for row, column in pairs}
    kept = set(old_of.values())
    parts, merged = {}, {}
    for column, new in enumerate(overlap.new_ids.tolist()):
        if new not in old_of and len(overlap.old_ids):
            row = int(overlap.common[:, column].argmax())
            if overlap.common[row, column] >= MOST_OF_IT * overlap.new_cells[column]:
                parts[new] = int(overlap.old_ids[row])
    for row, old in enumerate(overlap.old_ids.tolist()):
        if old not in kept and len(overlap.new_ids):
            column = int(overlap.common[row].argmax())
            if overlap.common[row, column] >= MOST_OF_IT * overlap.old_cells[row]:
                merged[old] = int(overlap.new_ids[column])
    return LastingObjects(old_of, parts, merged)


def _distinct(
    ids: NDArray[np.integer], cell: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct ids, and the distinct pairs of object and cell, sorted: indices of ids, and cells."""
    known, index = np.unique(ids.astype(np.int64), return_inverse=True)
    pairs, _ = distinct_rows(np.stack([cell, index.ravel()], axis=1))
    return known, pairs[:, 1], pairs[:, 0]
