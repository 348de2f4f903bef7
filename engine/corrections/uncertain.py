"""Where the views are least sure: how uncertain the points are that each camera sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..posed import Camera
from ..result_files import SemanticPoints

_CELLS = 48
"""Cells across the picture. In each, the nearest point hides what lies behind it."""
_BEHIND = 0.15
"""Metres that a point may lie behind the nearest one and still be seen."""


def entropy_of(confidence: NDArray[np.floating]) -> NDArray[np.float64]:
    """Bits of doubt [N] between a class that is right with this probability and all others: 0 is sure, 1 undecided."""
    share = np.clip(confidence.astype(np.float64), 1e-6, 1 - 1e-6)
    return np.asarray(np.where(share < 0.5, 1.0, -share * np.log2(share) - (1 - share) * np.log2(1 - share)))


def entropy_of_views(points: SemanticPoints, cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """The mean ``entropy_of`` the points that each camera sees, float64 [V]; 0 where it sees none."""
    doubt, found = entropy_of(points.confidence), np.zeros(len(cameras))
    for number, camera in enumerate(cameras):
        rows, pixel, depth = camera.seen(points.xyz)
        column, row = (pixel * (_CELLS / camera.width)).astype(np.int64).T
        cell = row * _CELLS + column
        nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)
        np.minimum.at(nearest, cell, depth)
        seen = rows[depth <= nearest[cell] + _BEHIND]
        found[number] = doubt[seen].mean() if len(seen) else 0.0
    return found
