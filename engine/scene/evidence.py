"""How much a view's vote counts, by how well the view resolves what it votes on (ours, beyond the paper).

A network recognises a sink from 1 m away and calls it a countertop from 4 m, and far views outnumber near ones. Pixels
and resolution are counted at the size of the frame's own mask, whatever size the frame is read at. When a finished lift
is compared with its masks, only near views that resolve an object (``resolves``) have a vote on it."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..posed.frames import Camera
from ..presets.preset import EvidenceKind
from .view import View

_POWERS: dict[EvidenceKind, tuple[float, float]] = {
    "views": (0.0, 0.0),
    "root": (0.5, 0.0),
    "resolution": (0.0, 1.0),
    "pixels": (1.0, 0.0),
    "density": (0.0, 2.0),
}
"""Exponents of the pixel count and of the resolution."""

LEAST_PIXELS = 100  # a view resolves a segment with at least this many pixels
NEAR = 0.5  # a view is near if its resolution is at least this fraction of the best view's

Amounts = TypeVar("Amounts", float, NDArray[np.floating])


def evidence_of_pixels(kind: EvidenceKind) -> float:
    """Return the exponent by which the number of pixels enters the weight of a view's vote."""
    return _POWERS[kind][0]


def evidence_of_resolution(kind: EvidenceKind, resolution: Amounts) -> Amounts:
    """Return the factor, [...], that ``resolution`` [...], in pixels per centimetre, gives the votes of a view."""
    return resolution ** _POWERS[kind][1]


def evidence(kind: EvidenceKind, pixels: NDArray[np.floating], resolution: NDArray[np.floating]) -> NDArray[np.float64]:
    """Weights of votes, float64 [n], by the segments' ``pixels`` [n] and ``resolution`` [n] (pixels per cm)."""
    of_pixels = np.power(np.asarray(pixels, np.float64), evidence_of_pixels(kind))
    return of_pixels * evidence_of_resolution(kind, np.asarray(resolution, np.float64))


def resolution_on(camera: Camera, depth: NDArray[np.floating], mask_scale: float) -> NDArray[np.float32]:
    """Return how many pixels of the frame's own mask lie on a centimetre of a surface, float32 [...]; 0 for no depth.
    ``depth`` float32 [...] is the surface's, in metres. ``mask_scale`` is that of ``View``."""
    focal = mask_scale * np.sqrt(camera.fx * camera.fy)  # the geometric mean keeps a pixel's area
    return np.divide(0.01 * focal, depth, out=np.zeros_like(depth), where=depth > 0).astype(np.float32)


def resolution_of(view: View) -> NDArray[np.float32]:
    """Return how many pixels per centimetre a view has on the surface at each of its pixels, float32 [H, W]."""
    return resolution_on(view.camera, view.depth, view.mask_scale)


def resolves(pixels: float, mask_scale: float) -> bool:
    """Whether a view resolves a segment with this many ``pixels`` of the view. ``mask_scale`` is as in `View`."""
    return pixels * mask_scale**2 >= LEAST_PIXELS


def are_near(resolution: NDArray[np.floating], best: float) -> NDArray[np.bool_]:
    """Return which views of a point are near, bool [V]: their ``resolution`` [V] of it almost reaches the ``best``."""
    return resolution >= NEAR * best
