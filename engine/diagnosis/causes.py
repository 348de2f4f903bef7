"""What a cause that was found is called, and the sentence that a user reads."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from .examined import Examined
from .finding import Finding
from .pictures import depth_errors
from .reprojection import Assumption
from .trials import Agreement, Found

FIX = "--fix OUT writes the scene with it mended"
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


def cause_finding(examined: Examined, cause: Found, before: Assumption) -> Finding:
    text, option, figures = _said(examined, cause, before)
    one, other = examined.telling_pair(cause.assumed)
    shown = depth_errors(
        examined.views, one, other, [("as it is", before), (f"with {_NAMES[cause.cause]}", cause.assumed)]
    )
    return Finding(
        cause=_CAUSES[cause.cause],
        severity="wrong",
        text=f"{text}: {_agreeing(cause.before, cause.after)}",
        option=f"{option}; {FIX}",
        figures={**figures, **agreement_figures(cause.before, cause.after)},
        is_mended=True,
        picture=shown,
    )


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


def _agreeing(before: Agreement, after: Agreement) -> str:
    return (
        f"of the points carried into other views {_overall(after):.0%} lie on the depth there, and "
        f"{_overall(before):.0%} as the scene is"
    )


def _overall(views: Agreement) -> float:
    """The share of all points, in view of the other look or not, that agree."""
    return views.seen * views.share


def agreement_figures(before: Agreement, after: Agreement) -> dict[str, float | str]:
    return {
        "agreeing_before": _overall(before),
        "agreeing_after": _overall(after),
        "error_before": before.error,
        "error_after": after.error,
    }
