"""Which points a brush paints in a 3D view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_CELL = 8
"""Pixels: in each such square the nearest point hides what lies behind it."""
_BEHIND = 0.15
"""Metres that a point may lie behind the nearest one and still be painted."""


def painted(
    xyz: NDArray[np.float32],
    to_view: NDArray[np.float64],
    size: tuple[int, int],
    stroke: Sequence[tuple[float, float]],
    radius: float,
) -> NDArray[np.bool_]:
    """The points [N, 3] under a stroke, bool [N]. ``to_view`` [4, 4] is the view's perspective matrix, ``size`` its
    width and height in pixels, ``stroke`` the brush's places in pixels, y up, and ``radius`` its own."""
    seen = np.c_[xyz, np.ones(len(xyz))] @ to_view.T
    depth = seen[:, 3]
    pixel = (seen[:, :2] / np.where(depth > 1e-6, depth, np.inf)[:, None] * 0.5 + 0.5) * np.array(size)
    inside = (depth > 1e-6) & (pixel >= 0).all(axis=1) & (pixel < np.array(size)).all(axis=1)
    rows = np.flatnonzero(inside)
    cell = (pixel[rows] // _CELL).astype(np.int64) @ np.array([1, size[0] // _CELL + 1])
    nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(nearest, cell, depth[rows])
    rows = rows[depth[rows] <= nearest[cell] + _BEHIND]
    under = np.zeros(len(rows), bool)
    for place in stroke:
        under |= ((pixel[rows] - np.array(place)) ** 2).sum(axis=1) <= radius**2
    chosen = np.zeros(len(xyz), bool)
    chosen[rows[under]] = True
    return chosen
