"""Find which of the first anchors are in free space: views measure depth behind them. A noisy sensor, pixels that mix
both sides of an edge, and planes that are extended over holes leave such points in front of the real surface. Training
makes their Gaussians transparent, which takes hundreds of steps. Not in the paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import View, made_ahead

REACH, REACH_SHARE = 0.1, 0.04
"""A view shows a place if the depth that it measured there differs from the place's by at most this many metres, or
this fraction of the place's depth."""
FILLED = 0.3
"""A place that no view shows may still be a surface, such as a dark screen, if a place that a view shows is within
this many metres; else it is in free space."""


def in_free_space(xyz: NDArray[np.floating], views: Sequence[View]) -> NDArray[np.bool_]:
    """Return which places ``xyz`` [N, 3], metres, are in free space, bool [N]: places where views that look through
    outweigh views that show a surface, and places farther than FILLED from all that views show. A view weighs 1 /
    depth², as noise grows with depth. It looks through a place if it measures depth behind it, in the pixel and the
    eight around it: else thin things would be lost. All False if no view shows any of the places."""
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
    if not shown.any():
        return np.zeros(len(xyz), np.bool_)
    distance, _ = cKDTree(xyz[shown > 0]).query(xyz, distance_upper_bound=FILLED, workers=-1)
    free: NDArray[np.bool_] = (empty > shown) | np.isinf(distance)
    return free


def _nearest_around(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the least depth of each pixel and the eight around it, [H, W], metres; infinite where none has depth."""
    import cv2

    known = np.where(depth > 0, depth, np.float32(np.inf))
    return np.asarray(cv2.erode(known, np.ones((3, 3), np.uint8)), np.float32)
