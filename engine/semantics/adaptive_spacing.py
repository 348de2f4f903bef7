"""Where the points of a large scene's cloud lie.

Such a scene has more surface than the cloud may have points. So points are dense where labels change, and sparse in
between, on walls and floors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .clustering import cell_keys, merge_cells, merged_points

ENLARGED = 2.0
"""Spacing adapts above this multiple of the wanted spacing. Smaller rooms are sampled evenly."""
MIXED = 0.2
"""Share of the votes against a cell's winner above which labels change within the cell."""
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
    batches: LabelledBatches, centres: NDArray[np.float64], spacing: float, classes: int, wanted: float, cap: int
) -> NDArray[np.float64]:
    """Centres float64 [K, 3] that are dense where labels change, and twice as far apart elsewhere. There are about as
    many as ``centres``, and at most ``cap``; none are nearer than ``wanted`` metres.

    ``centres``: one for every occupied cell of ``spacing`` metres, in the order of the cells; ``classes``: the number
    of classes that the columns stand for.
    """
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
    """Where labels change: within a cell, or from it to one of its 26 neighbours."""
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
