"""Findings on the numbers of a scene: what poses, depth and intrinsics mean."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from .calibration import Calibration, calibrate, moved
from .examined import Examined
from .finding import Finding
from .pictures import depth_errors, edges_on
from .registration import Registration, depth_edges, measure_registration
from .reprojection import Assumption
from .trials import Agreement, Found, agreement, find_causes

_FIX = "--fix OUT writes the scene with it mended"
_OFF_UNIT, _OFF_FOCAL = 0.025, 0.03
"""Logarithms: sensors' own scales and calibrations differ by one or two per cent."""
_OFF_RAY = 0.3
_OFF_PIXELS = 0.3
_ABOVE_NOISE = 2.0
"""A shift of the principal point counts where it moves surfaces by more than so many times the median error left."""
_HALF, _NEARLY = 0.5, 0.1
_SIGMAS = 5.0
_MORE, _LESS = 1.03, 0.7
_MOVED, _SCALED = 0.0075, 0.03
"""Of the width: colour and depth of one sensor are seldom registered better than to a few pixels of 640."""
_GAIN = 0.1
_SAME_SHIFT = 0.4

Shift = tuple[float, float]


def number_findings(examined: Examined) -> tuple[list[Finding], Assumption, Shift]:
    """Findings, what the numbers mean, and the shift that depth needs, in shares of the picture."""
    causes, assumed = find_causes(examined.views, examined.pairs)
    findings = []
    for number, cause in enumerate(causes):
        before = Assumption() if number == 0 else causes[number - 1].assumed
        findings.append(_of_cause(examined, cause, before))
    calibration = calibrate(examined.views, examined.pairs, assumed, points=200)
    registration = measure_registration(examined.looks, examined.photos)
    lies_aside = registration is not None and _lies_aside(registration)
    shift: Shift = (0.0, 0.0)
    if registration is not None and lies_aside:
        is_depth = calibration is not None and _same_shift(registration, calibration)
        findings.append(_of_registration(examined, registration, is_depth))
        shift = registration.shift if is_depth else shift
    if calibration is not None:
        more, assumed = _of_calibration(examined, calibration, assumed, may_move=shift == (0.0, 0.0))
        findings.extend(more)
    return findings, assumed, shift


def _of_cause(examined: Examined, cause: Found, before: Assumption) -> Finding:
    text, option, figures = _said(examined, cause, before)
    one, other = examined.telling_pair(cause.assumed)
    shown = depth_errors(
        examined.views, one, other, [("as it is", before), (f"with {_NAMES[cause.cause]}", cause.assumed)]
    )
    return Finding(
        cause=_CAUSES[cause.cause],
        severity="wrong",
        text=f"{text}: {_agreeing(cause.before, cause.after)}",
        option=f"{option}; {_FIX}",
        figures={**figures, **_agreement_figures(cause.before, cause.after)},
        is_mended=True,
        picture=shown,
    )


_CAUSES = {
    "inverted": "inverted poses",
    "opengl": "wrong axes",
    "inverted opengl": "inverted poses and wrong axes",
    "unit": "depth unit",
    "ray": "ray depth",
    "not ray": "depth divided by the ray",
    "swapped": "swapped focal lengths",
    "lens size": "intrinsics of another size",
    "focal": "focal length",
    "centre": "principal point",
}
_NAMES = {
    "inverted": "poses inverted",
    "opengl": "y down and z forward",
    "inverted opengl": "poses inverted, y down and z forward",
    "unit": "another unit of depth",
    "ray": "depth along the axis",
    "not ray": "depth along the axis",
    "swapped": "fx and fy swapped",
    "lens size": "intrinsics scaled",
    "focal": "another focal length",
    "centre": "another principal point",
}


def _said(examined: Examined, cause: Found, before: Assumption) -> tuple[str, str, dict[str, float | str]]:
    """What is wrong, what to do about it in the user's own files, and the figures."""
    now = cause.assumed
    if cause.cause == "unit":
        factor = now.unit / before.unit
        steps = 1.0 / factor
        known = f"{1000 * steps:.0f} steps a metre" if steps >= 0.3 else f"{1000 * steps:.3g} steps a metre"
        text = f"depth is in another unit, {steps:.4g} times too long (as if written with {known} and read with 1000)"
        return text, f"multiply depth by {factor:.4g}", {"factor": factor}
    if cause.cause == "lens size":
        scale = now.lens_scale / before.lens_scale
        width, height = examined.scene.frames[0].size
        text = f"the intrinsics belong to pictures of {width / scale:.0f}x{height / scale:.0f}, not {width}x{height}"
        return text, f"multiply fx, fy, cx and cy by {Fraction(scale).limit_denominator(12)}", {"factor": scale}
    if cause.cause == "focal":
        factor = now.focal / before.focal
        return f"fx and fy are {1 / factor:.3f} times too long", f"multiply them by {factor:.4f}", {"factor": factor}
    if cause.cause == "centre":
        width, height = examined.scene.frames[0].size
        x, y = (np.median(examined.views.lens_of(now)[:, 2:], axis=0) * (width, height)).tolist()
        return "the principal point is wrong", f"set cx, cy to {x:.1f}, {y:.1f}", {"cx": x, "cy": y}
    text, option = _SENTENCES[cause.cause]
    return text, option, {}


_SENTENCES = {
    "inverted": ("poses are world-to-camera and are read as camera-to-world", "invert them"),
    "opengl": ("poses have y up and z backward, as OpenGL and Blender have", "negate their second and third columns"),
    "inverted opengl": (
        "poses are world-to-camera, of cameras with y up and z backward",
        "invert them, then negate their second and third columns",
    ),
    "ray": (
        "depth is the distance to the camera's centre, not along its axis",
        "divide it by the length of the ray ((u - cx) / fx, (v - cy) / fy, 1)",
    ),
    "not ray": (
        "depth was divided by the length of the ray, though it was along the axis already",
        "multiply it by the length of the ray ((u - cx) / fx, (v - cy) / fy, 1)",
    ),
    "swapped": ("fx and fy have changed places", "swap them"),
}


def _agreeing(before: Agreement, after: Agreement) -> str:
    return (
        f"of the points carried into other views {_overall(after):.0%} lie on the depth there, and "
        f"{_overall(before):.0%} as the scene is"
    )


def _overall(views: Agreement) -> float:
    """The share of all points, in view of the other look or not, that agree."""
    return views.seen * views.share


def _agreement_figures(before: Agreement, after: Agreement) -> dict[str, float | str]:
    return {
        "agreeing_before": _overall(before),
        "agreeing_after": _overall(after),
        "error_before": before.error,
        "error_after": after.error,
    }


def _lies_aside(found: Registration) -> bool:
    width_moved = max(abs(found.shift[0]), abs(found.shift[1]))
    displaced = width_moved >= _MOVED or abs(found.scale - 1.0) >= _SCALED
    return displaced and found.certainty >= _SIGMAS and found.gain >= _GAIN


def _same_shift(registration: Registration, calibration: Calibration) -> bool:
    """Whether depth's own geometry says that it was moved by as much as it lies beside the pictures."""
    if abs(registration.scale - 1.0) >= _SCALED:
        return False
    measured, wanted = np.array([calibration.of("x"), calibration.of("y")]), -np.array(registration.shift)
    return bool(np.linalg.norm(measured - wanted) < _SAME_SHIFT * np.linalg.norm(wanted))


def _of_registration(examined: Examined, found: Registration, is_depth: bool) -> Finding:
    width, height = examined.scene.frames[0].size
    x, y = found.shift[0] * width, found.shift[1] * height
    rows = range(0, len(examined.looks), max(1, len(examined.looks) // 12))
    row = max(rows, key=lambda row: len(depth_edges(examined.looks[row].depth)))
    look = examined.looks[row]
    edges = depth_edges(look.depth)
    fitted = (edges - 0.5) * found.scale + 0.5 + found.shift
    how = f"{abs(x):.1f} px to the {'left' if x > 0 else 'right'} and {abs(y):.1f} px {'above' if y > 0 else 'below'}"
    if is_depth:
        text, option = f"depth lies {how} of where the colour images have it", f"move it; {_FIX}"
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


def _of_calibration(
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
        figures |= {**_agreement_figures(before, after)}
        findings.append(
            Finding(
                cause,
                "wrong",
                f"{text}; the median error of depth falls from {before.error:.2%} to {after.error:.2%}",
                f"{option}; {_FIX}",
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
    return found.is_sure_of(axis, max(_OFF_PIXELS / pixels, _ABOVE_NOISE * left * focal), _SIGMAS)


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
