"""Clusters the primary point cloud (paper: K-means, section "Robust Semantic Anchor Point Discovery").

The paper gives no K, seeding or number of iterations. Here the seeds are the means of a grid's occupied cells, followed
by a few Lloyd steps, in which each point joins the nearest centre within one spacing. So K-means needs no randomness,
and its time grows linearly with the points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import OnDemand, made_ahead
from .cloud_index import CloudIndex

PointBatches = Sequence[NDArray[np.float64]]
"""The primary cloud in batches of world points, float64 [n, 3]; each may be computed when read, in any thread."""

_PENDING_ROWS = 2_000_000
"""Rows of merged batches that are collected before they are merged with each other."""
_BITS = 21
"""Bits of a cell's key for each axis."""
_OFFSET = 1 << (_BITS - 1)


def cell_keys(points: NDArray[np.floating], size: float) -> NDArray[np.int64]:
    """Return the cell floor(point / size) of each point, packed into one integer, int64 [N]; points [N, 3] and ``size``
    in metres. Raises ValueError if a point lies beyond 2^20 cells."""
    cells = np.floor(np.asarray(points, np.float64) / size).astype(np.int64)
    if cells.size and (cells.min() < -_OFFSET or cells.max() >= _OFFSET):
        raise ValueError(f"a point lies more than {_OFFSET} cells of {size} m from the origin")
    cells += _OFFSET
    keys: NDArray[np.int64] = (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]
    return keys


def seed_centres(batches: PointBatches, spacing: float, cap: int) -> tuple[NDArray[np.float64], float]:
    """Return the mean point of each occupied cell, float64 [K, 3], ordered by cell, and the cell size used: ``spacing``
    (metres), enlarged until at most ``cap`` cells are occupied."""
    cells = merged_points(batches, spacing)
    while len(cells) > cap:
        # Surfaces fill space as the square of the spacing. The small extra makes one or two rounds enough.
        spacing *= max(1.01, math.sqrt(len(cells) / cap))
        cells = merge_cells(cells, spacing)
    return cells[:, :3], spacing


def merged_points(batches: PointBatches, spacing: float) -> NDArray[np.float64]:
    """Merge all points [n, 3] of the batches that share a grid cell of side ``spacing`` (metres) to one row (mean x, y,
    z, count). Return the rows, [K, 4], ordered by cell."""
    cells = np.zeros((0, 4))
    pending: list[NDArray[np.float64]] = []
    rows = 0
    weighted = OnDemand(len(batches), lambda number: np.pad(batches[number], ((0, 0), (0, 1)), constant_values=1.0))
    for batch in made_ahead(weighted, lambda rows: merge_cells(rows, spacing)):
        pending.append(batch)
        rows += len(batch)
        if rows > _PENDING_ROWS:
            cells, pending, rows = merge_cells(np.concatenate([cells, *pending]), spacing), [], 0
    return merge_cells(np.concatenate([cells, *pending]), spacing)


def merge_cells(rows: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Merge rows (mean x, y, z, weight) [n, 4] whose means share a cell of side ``spacing`` metres; a row per cell."""
    if not len(rows):
        return rows
    keys, cell = np.unique(cell_keys(rows[:, :3], spacing), return_inverse=True)
    weight = np.bincount(cell, rows[:, 3], len(keys))
    means = [np.bincount(cell, rows[:, axis] * rows[:, 3], len(keys)) / weight for axis in range(3)]
    return np.column_stack([*means, weight])


def lloyd_step(batches: PointBatches, centres: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Assign each point to the nearest centre within ``spacing`` metres, and return the means of the points assigned to
    each centre, float64 [K, 3]. Centres without points are dropped, so K may shrink."""
    index = CloudIndex(centres)
    sums, counts = np.zeros((len(centres), 3)), np.zeros(len(centres))
    for points, nearest in made_ahead(batches, lambda points: (points, index.nearest(points, spacing))):
        members = nearest >= 0
        nearest, points = nearest[members], points[members]
        counts += np.bincount(nearest, minlength=len(centres))
        for axis in range(3):
            sums[:, axis] += np.bincount(nearest, points[:, axis], len(centres))
    kept = counts > 0
    means: NDArray[np.float64] = sums[kept] / counts[kept, None]
    return means
