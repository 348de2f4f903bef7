"""Findings on the numbers of a scene: what poses, depth and intrinsics mean."""

from __future__ import annotations

import numpy as np

from .calibration import Calibration, calibrate
from .causes import FIX, cause_finding
from .examined import Examined
from .finding import Finding
from .pictures import edges_on
from .registration import Registration, depth_edges, measure_registration
from .reprojection import Assumption
from .small_errors import calibration_findings
from .trials import find_causes

_CERTAIN = 5.0
"""Standard errors among the frames."""
_MOVED, _SCALED = 0.0075, 0.03
"""Of the width: colour and depth of one sensor are seldom registered better than to a few pixels of 640."""
_GAIN = 0.1
"""Standard deviations of the pictures' contrast, by which depth's edges fit better elsewhere."""
_CORROBORATED = 4.0
"""Standard errors that are enough where depth's own geometry says the same."""

Shift = tuple[float, float]


def number_findings(examined: Examined) -> tuple[list[Finding], Assumption, Shift]:
    """Findings, what the numbers mean, and the shift that depth needs, in shares of the picture."""
    causes, assumed = find_causes(examined.views, examined.pairs)
    findings = []
    for number, cause in enumerate(causes):
        before = Assumption() if number == 0 else causes[number - 1].assumed
        findings.append(cause_finding(examined, cause, before))
    calibration = calibrate(examined.views, examined.pairs, assumed, points=200)
    registration = measure_registration(examined.looks, examined.photos)
    shift: Shift = (0.0, 0.0)
    if registration is not None:
        moved = None if calibration is None else _depth_moved_by(examined, registration, calibration)
        if moved is not None:
            shift = moved
            findings.append(_of_registration(examined, registration._replace(scale=1.0, shift=moved), is_depth=True))
        elif _lies_aside(registration):
            findings.append(_of_registration(examined, registration, is_depth=False))
    if calibration is not None:
        more, assumed = calibration_findings(examined, calibration, assumed, may_move=shift == (0.0, 0.0))
        findings.extend(more)
    return findings, assumed, shift


def _lies_aside(found: Registration) -> bool:
    width_moved = max(abs(found.shift[0]), abs(found.shift[1]))
    displaced = width_moved >= _MOVED or abs(found.scale - 1.0) >= _SCALED
    return displaced and found.certainty >= _CERTAIN and found.gain >= _GAIN


def _depth_moved_by(examined: Examined, registration: Registration, calibration: Calibration) -> Shift | None:
    """The shift that depth needs, in shares of the picture, where its own geometry and the pictures' edges both say
    that it was moved: the edges fit better nearer to where geometry has it than to where it lies.
    """
    if abs(registration.scale - 1.0) >= _SCALED or registration.certainty < _CORROBORATED:
        return None
    shift = -np.array([calibration.of("x"), calibration.of("y")])
    pixel = 1.0 / examined.views.size[0]
    if not any(calibration.is_sure_of(name, float(least)) for name, least in zip("xy", 0.75 * pixel, strict=True)):
        return None
    if np.linalg.norm(np.array(registration.shift) - shift) > 0.5 * np.linalg.norm(shift):
        return None
    return float(shift[0]), float(shift[1])


def _of_registration(examined: Examined, found: Registration, is_depth: bool) -> Finding:
    width, height = examined.scene.frames[0].size
    x, y = found.shift[0] * width, found.shift[1] * height
    rows = range(0, len(examined.looks), max(1, len(examined.looks) // 12))
    row = max(rows, key=lambda row: len(depth_edges(examined.looks[row].depth)))
    look = examined.looks[row]
    edges = depth_edges(look.depth)
    fitted = (edges - 0.5) * found.scale + 0.5 + found.shift
    sides = [(abs(x), "to the left" if x > 0.0 else "to the right"), (abs(y), "above" if y > 0.0 else "below")]
    how = " and ".join(f"{pixels:.1f} px {side}" for pixels, side in sides if pixels >= 0.1)
    if is_depth:
        text, option = f"depth lies {how} of where the colour images have it", f"move it; {FIX}"
    else:
        text = (
            f"depth is not registered to the colour images: its edges fit them scaled by {found.scale:.3f} and moved "
        )
        text += f"by {x:.1f}, {y:.1f} px; the intrinsics are the depth camera's"
        option = "bring depth to the colour camera with the sensor's calibration, or use its registered images"
    return Finding(
        cause="colour-to-depth shift",
        severity="wrong",
        text=f"{text} ({found.certainty:.0f} standard errors, {found.frames} frames)",
        option=option,
        figures={"x_px": x, "y_px": y, "scale": found.scale, "gain": found.gain, "certainty": found.certainty},
        is_mended=is_depth,
        picture=edges_on(examined.photos[look.number].grey, edges, fitted),
    )
