"""Which of the first anchors stand in the air: where the depth that the views measured goes on behind them.

A noisy sensor, pixels that mix both sides of an edge, and planes that are extended over holes leave such points before
what is there. Training makes their Gaussians transparent, which takes hundreds of steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import View, made_ahead

REACH, REACH_SHARE = 0.1, 0.04
"""A view shows a place if its depth there differs by at most this many metres, or this fraction of the place's."""
FILLED = 0.3
"""Metres from the next place that a view shows within which one that none shows may be a surface: a dark screen."""


def in_free_space(xyz: NDArray[np.floating], views: Sequence[View]) -> NDArray[np.bool_]:
    """Return which places ``xyz`` [N, 3] metres the views look through, bool [N]. Views that measure depth behind a
    place speak for this, views that show a surface there against it (by 1 / depth² each, as noise grows with it); a
    place where no view shows a surface within FILLED is one, too. A view speaks for it only if it also looks through in
    the pixels around it: else thin things would be lost."""
    from scipy.spatial import cKDTree

    def of_view(view: View) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        row, y, x, depth = view.places_in(xyz)
        reach, measured = np.maximum(REACH, REACH_SHARE * depth), view.depth[y, x]
        is_shown = (measured > 0) & (np.abs(measured - depth) <= reach)
        is_empty = (measured > 0) & (_nearest_around(view.depth)[y, x] > depth + reach)
        return [(row[which], depth[which] ** -2) for which in (is_shown, is_empty)]

    shown, empty = np.zeros(len(xyz)), np.zeros(len(xyz))
    for found in made_ahead(views, of_view):
        for evidence, (row, amount) in zip((shown, empty), found, strict=True):
            evidence[row] += amount
    if not shown.any():  # no view measured anything here
        return np.zeros(len(xyz), np.bool_)
    distance, _ = cKDTree(xyz[shown > 0]).query(xyz, distance_upper_bound=FILLED, workers=-1)
    free: NDArray[np.bool_] = (empty > shown) | np.isinf(distance)
    return free


def _nearest_around(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The least depth of each pixel and the eight around it; infinite where none has depth."""
    import cv2

    known = np.where(depth > 0, depth, np.float32(np.inf))
    return np.asarray(cv2.erode(known, np.ones((3, 3), np.uint8)), np.float32)
