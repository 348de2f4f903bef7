"""Numbers that are off by a little: found by a fit, and believed where it explains the error that there is."""

from __future__ import annotations

import numpy as np

from .calibration import Calibration, calibrate, moved
from .causes import FIX, agreement_figures
from .examined import Examined
from .finding import Finding
from .pictures import depth_errors
from .reprojection import Assumption
from .trials import Agreement, agreement

_OFF_UNIT, _OFF_FOCAL = 0.025, 0.03
"""Logarithms: sensors' own scales and calibrations differ by one or two per cent."""
_OFF_RAY = 0.3
_OFF_PIXELS = 0.3
_ABOVE_NOISE = 2.0
"""A shift of the principal point counts where it moves surfaces by more than so many times the median error left."""
_HALF, _NEARLY = 0.5, 0.1
_MORE, _LESS = 1.03, 0.7
"""What explains the error makes so many times as many points agree, or leaves so much of the error."""


def calibration_findings(
    examined: Examined, found: Calibration, assumed: Assumption, may_move: bool
) -> tuple[list[Finding], Assumption]:
    """What the fit says beyond the causes; ``may_move``: the principal point was not explained by depth that moved."""
    left = agreement(examined.views, examined.pairs, moved(assumed, found.values)).error
    wrong = {
        "unit": found.is_sure_of("unit", _OFF_UNIT),
        "focal": found.is_sure_of("focal", _OFF_FOCAL),
        "aspect": found.is_sure_of("aspect", _OFF_FOCAL),
        "x": may_move and _is_moved(examined, found, "x", left),
        "y": may_move and _is_moved(examined, found, "y", left),
        "ray": found.is_sure_of("ray", _OFF_RAY),
    }
    free = tuple(name for name, is_wrong in wrong.items() if is_wrong)
    if {"x", "y"} & {*free}:
        free = tuple(dict.fromkeys((*free, "x", "y")))
    again = calibrate(examined.views, examined.pairs, assumed, free, points=200) if free else None
    if again is None:
        return [], assumed
    mended = moved(assumed, again.values)
    before, after = (agreement(examined.views, examined.pairs, each) for each in (assumed, mended))
    if not _explains(before, after):
        return [], assumed
    one, other = examined.telling_pair(mended)
    picture = depth_errors(examined.views, one, other, [("as it is", assumed), ("with the numbers measured", mended)])
    findings = []
    for cause, text, option, figures in _measured(examined, again, {*free}):
        figures |= {**agreement_figures(before, after)}
        findings.append(
            Finding(
                cause,
                "wrong",
                f"{text}; the median error of depth falls from {before.error:.2%} to {after.error:.2%}",
                f"{option}; {FIX}",
                figures,
                True,
                picture=picture,
            )  # fmt: skip
        )
    return findings, mended


def _explains(before: Agreement, after: Agreement) -> bool:
    """Whether most of the error goes, or many more points agree: poses that drift bend every number a little, and
    stay wrong with it.
    """
    return after.mean > _MORE * before.mean or (after.mean >= before.mean and after.error < _LESS * before.error)


def _is_moved(examined: Examined, found: Calibration, axis: str, left: float) -> bool:
    column = "xy".index(axis)
    pixels = examined.looks[0].frame.size[column]
    focal = float(np.median(examined.views.lens[:, column]))
    return found.is_sure_of(axis, max(_OFF_PIXELS / pixels, _ABOVE_NOISE * left * focal))


def _measured(
    examined: Examined, found: Calibration, free: set[str]
) -> list[tuple[str, str, str, dict[str, float | str]]]:
    """(cause, sentence, what to do, figures) of each number that is off."""
    said: list[tuple[str, str, str, dict[str, float | str]]] = []
    if "unit" in free:
        factor = float(np.exp(found.of("unit")))
        text = f"depth is {1 / factor:.3f} times too long (within {found.deviation('unit'):.1%})"
        said.append(("depth unit", text, f"multiply it by {factor:.4f}", {"factor": factor}))
    if free & {"focal", "aspect"}:
        fy = float(np.exp(found.of("focal") if "focal" in free else 0.0))
        fx = fy * float(np.exp(found.of("aspect") if "aspect" in free else 0.0))
        text = f"fx is {1 / fx:.3f} and fy {1 / fy:.3f} times too long"
        said.append(("focal length", text, f"multiply them by {fx:.4f} and {fy:.4f}", {"fx": fx, "fy": fy}))
    if "x" in free:
        said.append(_of_principal_point(examined, found))
    if "ray" in free:
        share = -found.of("ray")
        text = f"depth is along the axis but for {share:.0%} of the ray's length"
        said.append(("ray depth", text, "write depth along the axis", {"share": share}))
    return said


def _of_principal_point(examined: Examined, found: Calibration) -> tuple[str, str, str, dict[str, float | str]]:
    look = examined.looks[0]
    off = np.array([found.of("x"), found.of("y")])
    errors = np.array([found.deviation("x"), found.deviation("y")])
    x, y = (off * look.frame.size).tolist()
    figures: dict[str, float | str] = {"x_px": x, "y_px": y}
    for whose, size in (("colour", look.frame.size), ("depth", (look.camera.width, look.camera.height))):
        pixels, within = off * size, errors * size
        near = np.abs(np.abs(pixels) - _HALF) < _NEARLY + 3.0 * within
        if near.all() and pixels[0] * pixels[1] > 0.0 and (within < _NEARLY).all():
            sign = "+" if pixels[0] > 0.0 else "-"
            text = f"the principal point is half a {whose} pixel off ({x:+.2f}, {y:+.2f} px, within {within.max():.2f})"
            meant = "pixels' centres are not where the format has them"
            return "half a pixel", f"{text}: {meant}", f"add {sign}0.5 to cx and cy", figures
    within = errors * look.frame.size
    text = f"the principal point is {-x:+.2f}, {-y:+.2f} px off (within {within[0]:.2f}, {within[1]:.2f})"
    return "principal point", text, f"add {x:+.2f} to cx and {y:+.2f} to cy", figures
