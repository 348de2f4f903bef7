"""How much a view's word counts: by how well it resolves what it speaks of (ours, beyond the paper).

A network knows a sink from 1 m away and calls it a countertop from 4 m. There are more far views than near ones. So a
view has as many votes on a point, an object, a Gaussian, or on two masks, as its kind of evidence says. All of these
are counted at the size of the frame's own mask, whatever size the frame is read at.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..presets.preset import EvidenceKind
from .camera import Camera
from .view import View

_POWERS: dict[EvidenceKind, tuple[float, float]] = {
    "views": (0.0, 0.0),
    "root": (0.5, 0.0),
    "resolution": (0.0, 1.0),
    "pixels": (1.0, 0.0),
    "density": (0.0, 2.0),
}
"""The powers of the pixels and of the resolution."""

Amounts = TypeVar("Amounts", float, NDArray[np.floating])


def evidence_of_pixels(kind: EvidenceKind) -> float:
    """The power of the pixels in a view's votes."""
    return _POWERS[kind][0]


def evidence_of_resolution(kind: EvidenceKind, resolution: Amounts) -> Amounts:
    """The factor that the ``resolution`` [...], in pixels a centimetre, gives to a view's votes."""
    return resolution ** _POWERS[kind][1]


def evidence(kind: EvidenceKind, pixels: NDArray[np.floating], resolution: NDArray[np.floating]) -> NDArray[np.float64]:
    """A view's votes on things that it shows with ``pixels`` [n] at a mean ``resolution`` [n] in pixels a centimetre,
    float64 [n]."""
    of_pixels = np.power(np.asarray(pixels, np.float64), evidence_of_pixels(kind))
    return of_pixels * evidence_of_resolution(kind, np.asarray(resolution, np.float64))


def resolution_on(camera: Camera, depth: NDArray[np.float32], mask_scale: float) -> NDArray[np.float32]:
    """Pixels a centimetre of the frame's own mask on the surface at ``depth`` float32 [H, W] metres, float32 [H, W]; 0
    where there is no depth. ``mask_scale`` is that of ``View``."""
    focal = mask_scale * np.sqrt(camera.fx * camera.fy)
    return np.divide(0.01 * focal, depth, out=np.zeros_like(depth), where=depth > 0).astype(np.float32)


def resolution_of(view: View) -> NDArray[np.float32]:
    """``resolution_on`` what a view sees."""
    return resolution_on(view.camera, view.depth, view.mask_scale)
