"""Clustering the primary point cloud (paper: K-means, section "Robust Semantic Anchor Point Discovery").

The paper gives neither K nor the seeding nor the iterations. Here the seeds are the means of a grid's occupied cells. A
few Lloyd steps follow, in which each point moves to the nearest centre within one spacing. So K-means needs no
randomness, and its time grows linearly with the points. In a scene too large for an even cloud, points are dense where
labels change, and sparse in between, on walls and floors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cloud_index import CloudIndex

PointBatches = Callable[[], Iterable[NDArray[np.float64]]]
"""Returns the primary cloud from its start each time it is called, in batches of world points, float64 [n, 3]."""

_PENDING_ROWS = 2_000_000
"""Rows of merged batches that are collected before they are merged with each other."""
_BITS = 21
"""Bits of a cell's key for each axis."""
_OFFSET = 1 << (_BITS - 1)


def cell_keys(points: NDArray[np.floating], size: float) -> NDArray[np.int64]:
    """The cell floor(point / size) of each point, packed into one integer: points [N, 3] and ``size`` in metres,
    int64 [N]. Raises ValueError when a point lies beyond 2^20 cells."""
    cells = np.floor(np.asarray(points, np.float64) / size).astype(np.int64)
    if cells.size and (cells.min() < -_OFFSET or cells.max() >= _OFFSET):
        raise ValueError(f"a point lies more than {_OFFSET} cells of {size} m from the origin")
    cells += _OFFSET
    keys: NDArray[np.int64] = (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]
    return keys


def seed_centres(batches: PointBatches, spacing: float, cap: int) -> tuple[NDArray[np.float64], float]:
    """One centre per occupied cell, the mean of its points: float64 [K, 3] with K <= ``cap``, ordered by cell; and the
    spacing used: ``spacing`` (metres) is enlarged until no more than ``cap`` cells are occupied."""
    cells = merged_points(batches(), spacing)
    while len(cells) > cap:
        # Surfaces fill space as the square of the spacing. The small extra makes one or two rounds enough.
        spacing *= max(1.01, math.sqrt(len(cells) / cap))
        cells = merge_cells(cells, spacing)
    return cells[:, :3], spacing


def merged_points(batches: Iterable[NDArray[np.float64]], spacing: float) -> NDArray[np.float64]:
    """Points [n, 3] of the batches that share a cell become one row (mean x, y, z, weight), [K, 4], ordered by cell."""
    cells = np.zeros((0, 4))
    pending: list[NDArray[np.float64]] = []
    rows = 0
    for points in batches:
        batch = merge_cells(np.column_stack([points, np.ones(len(points))]), spacing)
        pending.append(batch)
        rows += len(batch)
        if rows > _PENDING_ROWS:
            cells, pending, rows = merge_cells(np.concatenate([cells, *pending]), spacing), [], 0
    return merge_cells(np.concatenate([cells, *pending]), spacing)


def merge_cells(rows: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Rows (mean x, y, z, weight) [n, 4] that share a cell become one row, ordered by cell."""
    if not len(rows):
        return rows
    keys, cell = np.unique(cell_keys(rows[:, :3], spacing), return_inverse=True)
    weight = np.bincount(cell, rows[:, 3], len(keys))
    means = [np.bincount(cell, rows[:, axis] * rows[:, 3], len(keys)) / weight for axis in range(3)]
    return np.column_stack([*means, weight])


def lloyd_step(batches: PointBatches, centres: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Assign each point to the nearest centre within ``spacing`` and return the members' means, float64 [K, 3]. A
    centre that lost all its members is dropped, so K may shrink."""
    index = CloudIndex(centres)
    sums, counts = np.zeros((len(centres), 3)), np.zeros(len(centres))
    for points in batches():
        nearest = index.nearest(points, spacing)
        members = nearest >= 0
        nearest, points = nearest[members], points[members]
        counts += np.bincount(nearest, minlength=len(centres))
        for axis in range(3):
            sums[:, axis] += np.bincount(nearest, points[:, axis], len(centres))
    kept = counts > 0
    means: NDArray[np.float64] = sums[kept] / counts[kept, None]
    return means


ENLARGED = 2.0
"""Spacing adapts above this multiple of the wanted spacing. Smaller rooms are sampled evenly."""
MIXED = 0.2
"""Share of a cell's votes against its winner above which labels change within the cell."""
LEAST_GAIN = 0.8
"""Share of the cells with changing labels above which an even spacing does just as well."""

ColumnedPoints = tuple[NDArray[np.float64], NDArray[np.int64]]
"""World points [n, 3] in metres, and the column of votes of each one's class, -1 = none."""
LabelledBatches = Callable[[], Iterable[ColumnedPoints]]


class _Cells(NamedTuple):
    """Cells of ``spacing`` metres: ``keys`` int64 [K], ascending; ``is_edge`` bool [K], whether labels change there."""

    keys: NDArray[np.int64]
    is_edge: NDArray[np.bool_]
    spacing: float

    def hold(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of the points [n, 3] lie where labels change."""
        keys = cell_keys(points, self.spacing)
        row = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return self.is_edge[row] & (self.keys[row] == keys)


def adapted_centres(
    batches: LabelledBatches, centres: NDArray[np.float64], spacing: float, classes: int, *, wanted: float, cap: int
) -> NDArray[np.float64]:
    """Centres float64 [K, 3] that are dense where labels change, and twice as far apart elsewhere. There are about as
    many as ``centres``, and at most ``cap``; none are closer than ``wanted`` metres. ``centres``: one for every
    occupied cell of ``spacing`` metres, in the order of the cells; ``classes``: the number of columns of votes."""
    cells = _edges(batches, np.sort(cell_keys(centres, spacing)), spacing, classes)
    share = float(cells.is_edge.mean())
    if share > LEAST_GAIN:
        return centres
    fine = max(wanted, spacing * math.sqrt(share + (1.0 - share) / 4.0))
    at_edges = merged_points((points[cells.hold(points)] for points, _ in batches()), fine)
    between = merged_points((points[~cells.hold(points)] for points, _ in batches()), 2.0 * fine)
    while len(at_edges) + len(between) > cap:
        fine *= max(1.01, math.sqrt((len(at_edges) + len(between)) / cap))
        at_edges, between = merge_cells(at_edges, fine), merge_cells(between, 2.0 * fine)
    return np.concatenate([at_edges, between])[:, :3]


def _edges(batches: LabelledBatches, keys: NDArray[np.int64], spacing: float, classes: int) -> _Cells:
    """Whether labels change in each cell, or from it to one of its 26 neighbours."""
    votes = np.zeros(len(keys) * classes)
    for points, column in batches():
        own = cell_keys(points, spacing)
        row = np.minimum(np.searchsorted(keys, own), len(keys) - 1)
        voting = (column >= 0) & (keys[row] == own)
        votes += np.bincount(row[voting] * classes + column[voting], minlength=len(votes))
    by_class = votes.reshape(len(keys), classes)
    total, winner = by_class.sum(1), by_class.argmax(1)
    is_edge = by_class.max(1, initial=0.0) < (1.0 - MIXED) * total
    for dx, dy, dz in np.ndindex(3, 3, 3):
        step = cell_keys(np.array([[dx - 1.0, dy - 1.0, dz - 1.0]]) + 0.5, 1.0) - cell_keys(np.full((1, 3), 0.5), 1.0)
        row = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        is_edge |= (keys[row] == keys + step) & (total > 0) & (total[row] > 0) & (winner[row] != winner)
    return _Cells(keys, is_edge, spacing)
