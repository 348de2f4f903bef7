"""Fill the holes that a depth sensor leaves on dark, shiny, grazing and far surfaces, which would get no anchors.

Most holes lie in a plane with their surroundings. The inverse depth of a plane is an affine function of the pixel, so a
hole is filled from the ring of measured pixels around it, of its own segment if that has enough of them. A hole whose
ring is not planar stays a hole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Depths = NDArray[np.float32]
Pixels = NDArray[np.bool_]


RING, _LEAST_RING = 6, 12  # the width in pixels of the ring around a hole, and how many of its pixels must have depth
_FLATNESS = 0.02  # the largest median residual of the plane relative to the depth
STRETCH = 2.5  # filled depth is within this many times the ring's nearest and farthest
_SPECK, _MANY = 9, 100
"""In a segment with more than this many holes, as a noisy sensor leaves, those of at most the first number of pixels
take the mean of the pixels around them, if these are flat."""


def fill_holes(depth: Depths, segments: NDArray[np.int32]) -> Depths:
    """Return depth with planar holes filled, float32 [H, W] metres, 0 = unknown. ``segments`` int32 [H, W] are the
    mask's ids: a hole ends where its segment does. Measured depth never changes."""
    import cv2

    filled = depth.copy()
    hole = depth <= 0
    if not hole.any() or hole.all():
        return filled
    for segment in np.unique(segments[hole]):
        own = segments == segment
        count, component, boxes, _ = cv2.connectedComponentsWithStats((hole & own).astype(np.uint8), connectivity=4)
        is_speck = (boxes[:, cv2.CC_STAT_AREA] <= _SPECK) & (count > _MANY)
        _fill_specks(filled, depth, is_speck[component] & hole & own)
        for number in np.flatnonzero(~is_speck[1:]) + 1:  # label 0 is everything else
            left, top, width, height = boxes[number, :4]
            rows = slice(max(top - RING, 0), top + height + RING)
            columns = slice(max(left - RING, 0), left + width + RING)
            inside = component[rows, columns] == number
            _fill_one(filled[rows, columns], depth[rows, columns], inside, own[rows, columns])
    return filled


def _fill_specks(filled: Depths, depth: Depths, speck: Pixels) -> None:
    """Fill all small holes (``speck``) at once in ``filled``, with the mean of the 5x5 pixels around if these are
    flat."""
    import cv2

    if not speck.any():
        return
    known = depth > 0
    count = cv2.blur(known.astype(np.float32), (5, 5), borderType=cv2.BORDER_CONSTANT)
    mean = cv2.blur(depth, (5, 5), borderType=cv2.BORDER_CONSTANT) / np.maximum(count, 1e-6)  # unknown: 0 in both
    farthest = cv2.dilate(depth, np.ones((5, 5), np.uint8))
    nearest = cv2.erode(np.where(known, depth, np.float32(np.inf)), np.ones((5, 5), np.uint8))
    flat = (count > 0) & (farthest / (1.0 + 2.0 * _FLATNESS) <= nearest)
    filled[speck & flat] = mean[speck & flat]


def _fill_one(filled: Depths, depth: Depths, inside: Pixels, own: Pixels) -> None:
    """Fill one hole, ``inside`` bool [h, w], in ``filled``; ``own`` is its segment. All arrays are crops around it."""
    import cv2

    size = 2 * RING + 1
    near = cv2.dilate(inside.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool) & (depth > 0)
    ring = near & own
    if ring.sum() < _LEAST_RING:
        ring = near  # the segment is hardly more than its hole
    if ring.sum() < _LEAST_RING:
        return
    y, x = np.nonzero(ring)
    measured = depth[ring].astype(np.float64)
    plane = _plane(x, y, 1.0 / measured)  # a plane is linear in 1 / depth
    fitted = plane[0] * x + plane[1] * y + plane[2]
    if np.median(np.abs(fitted * measured - 1.0)) > _FLATNESS:
        return
    y, x = np.nonzero(inside)
    inverse = plane[0] * x + plane[1] * y + plane[2]
    lowest, highest = 1.0 / (measured.max() * STRETCH), STRETCH / measured.min()
    usable = (inverse > lowest) & (inverse < highest)
    filled[y[usable], x[usable]] = 1.0 / inverse[usable]


def _plane(x: NDArray[np.intp], y: NDArray[np.intp], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit a x + b y + c to ``inverse`` depth [n] at pixels ``x``, ``y`` by robust least squares. Return [a, b, c]."""
    system = np.column_stack([x, y, np.ones(len(x))])
    weight = np.ones(len(x))
    solution = np.zeros(3)
    for _ in range(4):
        solution = np.linalg.lstsq(system * weight[:, None], inverse * weight, rcond=None)[0]
        residual = np.abs(system @ solution - inverse)
        weight = 1.0 / np.sqrt(1.0 + (residual / max(2.0 * float(np.median(residual)), 1e-6)) ** 2)  # Cauchy's
    return solution
