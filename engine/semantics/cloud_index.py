"""Nearest point of a cloud, by hashed cells.

The one geometric look-up of the lift: clustering asks for the nearest centre, projection for the nearest
labelled point. Compiled, because a lift asks it some 10^7 times.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..machine.threads import parallel_for, worker_count
from ..scene import Camera

_BITS = 21
_OFFSET = 1 << (_BITS - 1)
_CHUNK = 1024
"""Queries that a worker looks up at a time."""


def cell_keys(points: NDArray[np.floating], size: float) -> NDArray[np.int64]:
    """The cell of each point, packed into one integer: points [N, 3] in metres, ``size`` in metres, int64
    [N].

    Cells are floor(point / size), 21 bits an axis. Raises ValueError when a point lies beyond 2^20 cells.
    """
    cells = np.floor(np.asarray(points, np.float64) / size).astype(np.int64)
    if cells.size and (cells.min() < -_OFFSET or cells.max() >= _OFFSET):
        raise ValueError(f"a point lies more than {_OFFSET} cells of {size} m from the origin")
    cells += _OFFSET
    keys: NDArray[np.int64] = (cells[:, 0] << (2 * _BITS)) | (cells[:, 1] << _BITS) | cells[:, 2]
    return keys


class HashedPoints(NamedTuple):
    """``points`` float64 [N, 3] metres; ``order`` int64 [N], their rows sorted by cell; ``first`` int64 [cells + 1],
    the place in ``order`` of each cell's first; ``table_keys`` and ``table_cells`` int64, the open-addressed table from
    a cell's key to its number; ``size`` of a cell in metres."""

    points: NDArray[np.float64]
    order: NDArray[np.int64]
    first: NDArray[np.int64]
    table_keys: NDArray[np.int64]
    table_cells: NDArray[np.int64]
    size: float


class CloudIndex:
    """Points float [N, 3] (world metres) hashed into cells of ``cell_size`` metres.

    Choose the cell near the spacing of the points: look-ups are exact at any reach, but fast up to one cell.
    """

    def __init__(self, points: NDArray[np.floating], cell_size: float) -> None:
        if cell_size <= 0:
            raise ValueError(f"cell size must be positive, got {cell_size}")
        self.points = np.ascontiguousarray(points, np.float64)
        self.cell_size = float(cell_size)
        keys = cell_keys(self.points, self.cell_size)
        order = np.argsort(keys, kind="stable")
        unique, starts = np.unique(keys[order], return_index=True)
        first = np.append(starts, len(keys)).astype(np.int64)
        size = 1 << max(4, math.ceil(math.log2(2 * len(unique) + 1)))
        table_keys, table_cells = np.full(size, -1, np.int64), np.zeros(size, np.int64)
        _fill_table(unique, table_keys, table_cells)
        self._hashed = HashedPoints(self.points, order, first, table_keys, table_cells, self.cell_size)

    def __len__(self) -> int:
        return len(self.points)

    def nearest(self, queries: NDArray[np.floating], reach: float) -> NDArray[np.int32]:
        """Index of the nearest point within ``reach`` metres of each query [..., 3]; int32 [...], -1 where
        there is none.

        Equal distances go to the lower index.
        """
        flat = np.ascontiguousarray(queries, np.float64).reshape(-1, 3)
        found = np.full(len(flat), -1, np.int32)
        if len(self.points) and len(flat):
            limit = (_OFFSET - 1) * self.cell_size - reach
            usable = np.isfinite(flat).all(1) & (np.abs(flat) < limit).all(1)
            parallel_for(worker_count(), _nearest, flat, usable, self._hashed, float(reach), found)
        return found.reshape(queries.shape[:-1])

    def nearest_of_pixels(self, camera: Camera, depth: NDArray[np.float32], reach: float) -> NDArray[np.int32]:
        """Nearest point of each pixel's surface: depth float32 [H, W] metres, int32 [H, W], -1 for none or no
        depth.
        """
        valid = depth > 0
        found = np.full(depth.shape, -1, np.int32)
        found[valid] = self.nearest(camera.unproject(depth)[valid], reach)
        return found


@njit(cache=True, nogil=True)
def _table_slot(table_keys: Any, key: Any) -> Any:
    """Where a key is, or the free slot where it belongs (open addressing; the table is at most half full)."""
    mask = table_keys.size - 1
    mixed = key * -7046029254386353131
    slot = (mixed ^ (mixed >> 29)) & mask
    while table_keys[slot] != key and table_keys[slot] != -1:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def _fill_table(keys: Any, table_keys: Any, table_cells: Any) -> None:
    for i in range(keys.size):
        slot = _table_slot(table_keys, keys[i])
        table_keys[slot] = keys[i]
        table_cells[slot] = i


@njit(cache=True, nogil=True)
def _nearest(
    worker: Any, workers: Any, queries: Any, usable: Any, hashed: HashedPoints, reach: Any, found: Any
) -> None:
    """Every ``workers``-th chunk of the queries. The 27 cells around a query first; when nothing lies within one cell,
    every cell within reach."""
    size = hashed.size
    rings = int(np.ceil(reach / size))
    for start in range(worker * _CHUNK, queries.shape[0], workers * _CHUNK):
        for q in range(start, min(start + _CHUNK, queries.shape[0])):
            if not usable[q]:
                continue
            best, squared = _scan(queries[q], 1, hashed, reach * reach)
            # Beyond one cell a nearer point may lie outside the 27 cells.
            if rings > 1 and (best < 0 or squared > size * size):
                best, squared = _scan(queries[q], rings, hashed, reach * reach)
            found[q] = best


@njit(cache=True, nogil=True)
def _scan(query: Any, rings: Any, hashed: HashedPoints, limit: Any) -> Any:
    """Nearest point in the (2 rings + 1)^3 cells around the query: (index or -1, squared distance)."""
    x, y, z = query[0], query[1], query[2]
    points, order, first, size = hashed.points, hashed.order, hashed.first, hashed.size
    table_keys, table_cells = hashed.table_keys, hashed.table_cells
    cx, cy, cz = int(np.floor(x / size)), int(np.floor(y / size)), int(np.floor(z / size))
    best, squared = -1, limit
    for step_x in range(2 * rings + 1):
        ix = cx + _alternate(step_x)
        dx = _gap(x, ix, size)
        if dx * dx > squared:
            continue
        for step_y in range(2 * rings + 1):
            iy = cy + _alternate(step_y)
            dy = _gap(y, iy, size)
            if dx * dx + dy * dy > squared:
                continue
            for step_z in range(2 * rings + 1):
                iz = cz + _alternate(step_z)
                dz = _gap(z, iz, size)
                if dx * dx + dy * dy + dz * dz > squared:
                    continue
                key = ((ix + _OFFSET) << (2 * _BITS)) | ((iy + _OFFSET) << _BITS) | (iz + _OFFSET)
                slot = _table_slot(table_keys, key)
                if table_keys[slot] != key:
                    continue
                cell = table_cells[slot]
                for k in range(first[cell], first[cell + 1]):
                    p = order[k]
                    d = (points[p, 0] - x) ** 2 + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2
                    if d < squared or (d == squared and (best < 0 or p < best)):
                        best, squared = p, d
    return best, squared


@njit(cache=True, nogil=True)
def _alternate(step: Any) -> Any:
    """0, 1, -1, 2, -2 ...: the query's own cell first, so that far cells are skipped early."""
    return (step + 1) // 2 if step % 2 == 1 else -(step // 2)


@njit(cache=True, nogil=True)
def _gap(value: Any, cell: Any, size: Any) -> Any:
    """Distance of a coordinate from a cell's interval."""
    if value < cell * size:
        return cell * size - value
    if value > (cell + 1) * size:
        return value - (cell + 1) * size
    return 0.0
