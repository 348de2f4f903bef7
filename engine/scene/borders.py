"""Black borders that an undistortion leaves along a picture's sides: the camera saw nothing there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLACK, JPEG_BLACK = 2, 12
"""Largest median brightness of a border, and of its pixels: JPEG brightens those near the picture."""
THICKEST = 0.1
"""Share of the picture that a border at most reaches inwards. Thicker dark areas are things in the picture."""
SHORTEST = 0.125
"""The least share of a side that a border runs along."""
STEEPEST = 2
"""Pixels by which the thickness of a border changes at most from one pixel along the side to the next: an undistortion
is smooth, the outlines of furniture are not."""
SEAM = 2
"""Pixels beside a border in which resampling and JPEG have mixed it with the picture."""


def border_mask(colour: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The pixels of a picture uint8 [H, W, 3] that show only a black border; bool [H, W].

    A border is thin, black, smooth and runs along a side, at full size: measure it before the picture is made smaller.
    Dark things that touch the edge stay: they reach too far in, have ragged outlines or are not quite black.
    """
    import cv2

    sides = (colour[0], colour[-1], colour[:, 0], colour[:, -1])
    if all((side.max(axis=1) <= JPEG_BLACK).mean() < SHORTEST for side in sides):
        return np.zeros(colour.shape[:2], np.bool_)
    brightest = colour.max(axis=2)
    dark = cv2.medianBlur(brightest, 3) <= JPEG_BLACK  # the median: single pixels that JPEG made brighter
    border = np.zeros(dark.shape, np.bool_)
    for turns in range(4):  # each side in its turn is the upper one; a turned view writes into ``border`` itself
        _add_upper(np.rot90(border, turns), np.rot90(dark, turns), np.rot90(brightest, turns))
    if border.any():
        kernel = np.ones((2 * SEAM + 1, 2 * SEAM + 1), np.uint8)
        border = cv2.dilate(border.view(np.uint8), kernel).astype(np.bool_)
    return border


def _add_upper(border: NDArray[np.bool_], dark: NDArray[np.bool_], brightest: NDArray[np.uint8]) -> None:
    """Mark the border along the upper side, all [H, W], in ``border``."""
    height, width = dark.shape
    thickness = np.where(dark.all(axis=0), height, dark.argmin(axis=0))
    is_thin = (thickness > 0) & (thickness <= THICKEST * height)
    is_torn = ~is_thin[1:] | ~is_thin[:-1] | (np.abs(np.diff(thickness)) > STEEPEST)
    for stretch in np.split(np.arange(width), np.flatnonzero(is_torn) + 1):
        inside = np.arange(height)[:, None] < np.where(is_thin, thickness, 0)[stretch]
        if len(stretch) >= SHORTEST * width and inside.any() and np.median(brightest[:, stretch][inside]) <= BLACK:
            border[:, stretch] |= inside
