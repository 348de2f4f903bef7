"""How much a view's vote counts: by how well it resolves what it votes on (ours, beyond the paper).

A network knows a sink from 1 m away and calls it a countertop from 4 m. There are more far views than near ones. So a
view has as many votes on a point, an object, a Gaussian, or on two masks, as its kind of evidence says. All of these
are counted at the size of the frame's own mask, whatever size the frame is read at.

Where the masks judge a finished lift, a view names only what it ``resolves``, and only near views answer.
"""

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
"""The powers of the pixels and of the resolution."""

LEAST_PIXELS = 100
"""A view resolves a segment of at least this many pixels."""
NEAR = 0.5
"""A view is near if it has at least this share of the best view's resolution."""

Amounts = TypeVar("Amounts", float, NDArray[np.floating])


def evidence_of_pixels(kind: EvidenceKind) -> float:
    """The power of the pixels in a view's votes."""
    return _POWERS[kind][0]


def evidence_of_resolution(kind: EvidenceKind, resolution: Amounts) -> Amounts:
    """The factor that the ``resolution`` [...], in pixels per centimetre, gives to a view's votes."""
    return resolution ** _POWERS[kind][1]


def evidence(kind: EvidenceKind, pixels: NDArray[np.floating], resolution: NDArray[np.floating]) -> NDArray[np.float64]:
    """A view's votes on things that it shows with ``pixels`` [n] at a mean ``resolution`` [n] in pixels per centimetre,
    float64 [n]."""
    of_pixels = np.power(np.asarray(pixels, np.float64), evidence_of_pixels(kind))
    return of_pixels * evidence_of_resolution(kind, np.asarray(resolution, np.float64))


def resolution_on(camera: Camera, depth: NDArray[np.floating], mask_scale: float) -> NDArray[np.float32]:
    """Pixels per centimetre of the frame's own mask on surfaces at ``depth`` float32 [...] metres, float32 [...]; 0
    where there is no depth. ``mask_scale`` is that of ``View``."""
    focal = mask_scale * np.sqrt(camera.fx * camera.fy)
    return np.divide(0.01 * focal, depth, out=np.zeros_like(depth), where=depth > 0).astype(np.float32)


def resolution_of(view: View) -> NDArray[np.float32]:
    """The ``resolution_on`` what a view sees."""
    return resolution_on(view.camera, view.depth, view.mask_scale)


def resolves(pixels: float, mask_scale: float) -> bool:
    """Whether a view resolves a segment of so many of its own ``pixels``."""
    return pixels * mask_scale**2 >= LEAST_PIXELS


def are_near(resolution: NDArray[np.floating], best: float) -> NDArray[np.bool_]:
    """Which views with this ``resolution`` [V] of a place are near it, bool [V]; ``best``: that of the best view."""
    return resolution >= NEAR * best
