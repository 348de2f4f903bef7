"""Find faults in the numbers of poses, depth and intrinsics: by trying causes, and by fitting values."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ..scene import Scene
from ..scene.depth import DepthMap
from .findings import FIX, Finding, depth_errors
from .registration import Shift, measure_registration, registration_findings
from .reprojection import Assumption, Examined
from .trials import Agreement, Calibration, FoundCause, agreement, calibrate, find_cause, is_far_better, moved

_OFF_UNIT, _OFF_FOCAL = 0.025, 0.03  # logarithms; sensors' own scales and calibrations differ by one or two per cent
_OFF_RAY = 0.3  # the fraction of the ray's length contained in depth
_OFF_PIXELS = 0.3
_RUINED = 1.5  # minimum factor by which views agree better without a cause that makes a lift pointless
_ABOVE_NOISE = 2.0  # a shift of the principal point must move surfaces by at least this many median errors
_HALF, _NEARLY = 0.5, 0.1  # pixels: a half-pixel shift, and its tolerance
_RAY = "the length of the ray ((u - cx) / fx, (v - cy) / fy, 1)"

Figures = dict[str, float | str]


class _CauseWords(NamedTuple):
    """Texts on a cause: its name, a picture's caption, what is wrong, the fix. `_cause_texts` writes empty ones."""

    name: str
    caption: str
    text: str = ""
    option: str = ""


_WORDS = {
    "inverted": _CauseWords(
        "inverted poses", "poses inverted", "poses are world-to-camera and are read as camera-to-world", "invert them"
    ),
    "opengl": _CauseWords(
        "wrong axes", "y down and z forward",
        "poses have y up and z backward, as in OpenGL and Blender", "negate their second and third columns",
    ),
    "inverted opengl": _CauseWords(
        "inverted poses and wrong axes", "poses inverted, y down and z forward",
        "poses are world-to-camera, of cameras with y up and z backward",
        "invert them, then negate their second and third columns",
    ),
    "unit": _CauseWords("depth unit", "another unit of depth"),
    "ray": _CauseWords(
        "ray depth", "depth along the axis",
        "depth is the distance to the camera's centre, not along its axis", f"divide it by {_RAY}",
    ),
    "lens size": _CauseWords("intrinsics of another size", "intrinsics scaled"),
    "focal": _CauseWords("focal length", "another focal length"),
    "length": _CauseWords("pose unit", "another unit of the poses"),
    "lag": _CauseWords("frames off", "poses of other frames"),
    "mirrored": _CauseWords(
        "mirrored images", "left and right swapped", "left and right are swapped in pictures and depth", "mirror them"
    ),
}  # fmt: skip

NUMBER_CAUSES = frozenset({*(words.name for words in _WORDS.values()), "principal point"})
"""The names of findings on poses, depth and intrinsics."""
_OTHERS_FOLLOW = "what else is wrong with the numbers may follow from it"
_ONLY_TOLD = ("lag", "mirrored")  # causes that users fix in their own files: only they can see which files are wrong


def lens_findings(scene: Scene, findings: list[Finding]) -> list[Finding]:
    """Return a finding that the lens is assumed, if it is. It is "wrong", not a note, if ``findings`` say that a number
    is off: then the lens is more likely to be the cause than values that files give."""
    if not scene.assumed_lens:
        return []
    is_wrong = any(finding.severity == "wrong" and finding.cause in NUMBER_CAUSES for finding in findings)
    text = f"{scene.assumed_lens}; {_OTHERS_FOLLOW}" if is_wrong else scene.assumed_lens
    option = "write the recorder's own lens there, then inspect again"
    return [Finding("assumed lens", text, option, "wrong" if is_wrong else "note")]


def number_findings(examined: Examined, lens_is_doubtful: bool = False) -> tuple[list[Finding], Assumption, Shift]:
    """Return findings about a scene's numbers, the assumption about what they mean, and the shift (x, y in fractions of
    the picture) that depth needs. With ``lens_is_doubtful``, a cause in the lens comes first."""
    cause = find_cause(examined.views, examined.pairs, lens_is_doubtful)
    assumed = Assumption() if cause is None else cause.assumed
    findings = [] if cause is None else [_cause_finding(examined, cause)]
    calibration = calibrate(examined.views, examined.pairs, assumed, points=200)
    registration = measure_registration(examined.looks, examined.photos)
    more, shift = registration_findings(examined, registration, calibration)
    findings += more
    if calibration is not None:
        more, assumed = _calibration_findings(examined, calibration, assumed, may_move=shift == (0.0, 0.0))
        findings += more
    return findings, assumed, shift


def are_numbers_off(examined: Examined) -> bool:
    """Whether a quick fit to few points finds a wrong unit, lens or depth, which `number_findings` then measures."""
    found = calibrate(examined.views, examined.pairs, Assumption(), points=60)
    return found is not None and bool(_values_off(examined, found, moved(Assumption(), found.values), may_move=True))


def _cause_finding(examined: Examined, cause: FoundCause) -> Finding:
    words = _WORDS[cause.cause]
    text, option, figures = _cause_texts(examined, cause)
    after = _agreement_figures(cause.before, cause.after)
    one, other = examined.telling_pair(cause.assumed)
    is_sure = cause.rival is None and cause.cause not in _ONLY_TOLD
    if cause.rival is not None:
        option = f"{option}, or check whether it is the {_WORDS[cause.rival].name}, which explains the views as well"
    assumptions = [("as it is", Assumption()), (f"with {words.caption}", cause.assumed)]
    return Finding(
        cause=words.name,
        text=f"{text}: of the points projected into other views, {after['agreeing_after']:.0%} then lie on the depth "
        f"there, against {after['agreeing_before']:.0%} now",
        option=f"{option}; {FIX}" if is_sure else option,
        figures={**figures, **after},
        is_mended=is_sure,
        picture=depth_errors(examined.views, one, other, assumptions),
        stops=cause.after.mean > _RUINED * cause.before.mean,
    )


def _off(factor: float) -> str:
    """Return a text that says how wrong a length is that must be multiplied by ``factor``."""
    return f"{1 / factor:.4g} times too long" if factor < 1.0 else f"{factor:.4g} times too short"


def _steps(examined: Examined, factor: float) -> str:
    """Return a text with the steps per metre in which depth was written and read; "" if its files store no steps."""
    read = examined.scene.frames[0].read_depth
    if not isinstance(read, DepthMap) or read.step is None:
        return ""
    per_metre = 1.0 / read.step
    return f" (as if written with {_round(per_metre / factor)} steps per metre, read with {_round(per_metre)})"


def _round(steps: float) -> str:
    return f"{steps:.0f}" if steps >= 300.0 else f"{steps:.3g}"


def _cause_texts(examined: Examined, cause: FoundCause) -> tuple[str, str, Figures]:
    """Return what is wrong, how to fix it in the user's files, and the numbers, for the ``cause`` that was found."""
    now = cause.assumed
    width, height = examined.scene.frames[0].size
    if cause.cause == "unit":
        factor = now.unit
        text = f"depth is in another unit, {_off(factor)}{_steps(examined, factor)}"
        return text, f"multiply depth by {factor:.4g}", {"factor": factor}
    if cause.cause == "length":
        factor = now.length
        text = f"the poses are in another unit, {_off(factor)}"
        return text, f"multiply the cameras' positions by {factor:.4g}", {"factor": factor}
    if cause.cause == "lag":
        lag = now.lag
        text = f"poses and depth are of different frames: depth fits the pose at an offset of {lag:+d} frames"
        return text, "check which of the two was numbered differently, and rename it", {"frames": float(lag)}
    if cause.cause == "lens size":
        scale = now.lens_scale
        text = f"the intrinsics belong to pictures of {width / scale:.0f}x{height / scale:.0f}, not {width}x{height}"
        return text, f"multiply fx, fy, cx and cy by {Fraction(scale).limit_denominator(12)}", {"factor": scale}
    if cause.cause == "focal":
        factor = now.focal
        return f"fx and fy are {_off(factor)}", f"multiply them by {factor:.4f}", {"factor": factor}
    return _WORDS[cause.cause].text, _WORDS[cause.cause].option, {}


def _agreement_figures(before: Agreement, after: Agreement) -> dict[str, float]:
    """Return the fractions of all points that agree ``before`` and ``after``, whether another frame sees them or not,
    and the errors, by name."""
    return {
        "agreeing_before": before.seen * before.share,
        "agreeing_after": after.seen * after.share,
        "error_before": before.error,
        "error_after": after.error,
    }


def _calibration_findings(
    examined: Examined, found: Calibration, assumed: Assumption, may_move: bool
) -> tuple[list[Finding], Assumption]:
    """Return findings from the fitted values, besides the cause, and the assumption with these values. ``may_move``
    says that no shift of depth explains the principal point."""
    free = _values_off(examined, found, moved(assumed, found.values), may_move)
    again = calibrate(examined.views, examined.pairs, assumed, free, points=200) if free else None
    if again is None:
        return [], assumed
    mended = moved(assumed, again.values)
    before, after = (agreement(examined.views, examined.pairs, each) for each in (assumed, mended))
    if not is_far_better(after, before):  # drifting poses bend every number a little
        is_better = after.mean > before.mean and after.error < before.error
        return [_doubtful_unit(again)] if is_better and again.is_sure_of("unit", _OFF_UNIT) else [], assumed
    one, other = examined.telling_pair(mended)
    picture = depth_errors(examined.views, one, other, [("as it is", assumed), ("with the measured numbers", mended)])
    findings = [
        Finding(
            cause=cause,
            text=f"{text}; the median error of depth falls from {before.error:.2%} to {after.error:.2%}",
            option=f"{option}; {FIX}",
            figures={**figures, **_agreement_figures(before, after)},
            is_mended=True,
            picture=picture,
        )
        for cause, text, option, figures in _measured(examined, again, {*free})
    ]
    return findings, mended


def _doubtful_unit(found: Calibration) -> Finding:
    """A note about a wrong unit that the fit is sure of, though correcting it improves little because of noise."""
    factor = float(np.exp(found.of("unit")))
    return Finding(
        cause="depth unit",
        severity="note",
        text=f"depth is {_off(factor)} (within {found.deviation('unit'):.1%}) by surfaces that views share, or poses "
        "are too near or too far; noise hides how much better views then agree",
        option=f"compare a known length with both; multiply depth by {factor:.3f}, or divide the poses' places by it",
        figures={"factor": factor},
    )


def _values_off(examined: Examined, found: Calibration, mended: Assumption, may_move: bool) -> tuple[str, ...]:
    """The names of values ("unit", "focal" …) that ``found`` shows to be off by more than tolerance, and by more than
    the noise left if they are ``mended``. The principal point, "x" and "y", is among them only if it ``may_move``."""
    left = agreement(examined.views, examined.pairs, mended).error
    pixels, focals = examined.looks[0].frame.size, np.median(examined.views.lens[:, :2], axis=0).tolist()
    x, y = (max(_OFF_PIXELS / p, _ABOVE_NOISE * left * focal) for p, focal in zip(pixels, focals, strict=True))
    least = {"unit": _OFF_UNIT, "focal": _OFF_FOCAL, "aspect": _OFF_FOCAL, "x": x, "y": y, "ray": _OFF_RAY}
    names = tuple(n for n in least if found.is_sure_of(n, least[n]) and (may_move or n not in ("x", "y")))
    return tuple(dict.fromkeys((*names, "x", "y"))) if {"x", "y"} & {*names} else names


def _measured(examined: Examined, found: Calibration, free: set[str]) -> list[tuple[str, str, str, Figures]]:
    """Return (cause, sentence, what to do, figures) for each of the numbers ``free`` that the fit ``found`` wrong."""
    measured: list[tuple[str, str, str, Figures]] = []
    if "unit" in free:
        factor = float(np.exp(found.of("unit")))
        text = f"depth is {_off(factor)} (within {found.deviation('unit'):.1%})"
        measured.append(("depth unit", text, f"multiply it by {factor:.4f}", {"factor": factor}))
    if free & {"focal", "aspect"}:
        fy = float(np.exp(found.of("focal") if "focal" in free else 0.0))
        fx = fy * float(np.exp(found.of("aspect") if "aspect" in free else 0.0))
        text = f"fx is {_off(fx)}, and fy {_off(fy)}"
        measured.append(("focal length", text, f"multiply them by {fx:.4f} and {fy:.4f}", {"fx": fx, "fy": fy}))
    if "x" in free:
        measured.append(_measured_principal_point(examined, found))
    if "ray" in free:
        share = -found.of("ray")
        text = f"depth is along the axis except for {share:.0%} of the ray's length"
        measured.append(("ray depth", text, "write depth along the axis", {"share": share}))
    return measured


def _measured_principal_point(examined: Examined, found: Calibration) -> tuple[str, str, str, Figures]:
    look = examined.looks[0]
    off = np.array([found.of("x"), found.of("y")])
    errors = np.array([found.deviation("x"), found.deviation("y")])
    x, y = (off * look.frame.size).tolist()
    figures: Figures = {"x_px": x, "y_px": y}
    for whose, size in (("colour", look.frame.size), ("depth", (look.camera.width, look.camera.height))):
        pixels, within = off * size, errors * size
        near = np.abs(np.abs(pixels) - _HALF) < _NEARLY + 3.0 * within
        if near.all() and pixels[0] * pixels[1] > 0.0 and (within < _NEARLY).all():
            sign = "+" if pixels[0] > 0.0 else "-"
            text = f"the principal point is half a {whose} pixel off ({x:+.2f}, {y:+.2f} px, within {within.max():.2f})"
            meant = "pixel centres are not where the format puts them"
            return "half a pixel", f"{text}: {meant}", f"add {sign}0.5 to cx and cy", figures
    within = errors * look.frame.size
    text = f"the principal point is {-x:+.2f}, {-y:+.2f} px off (within {within[0]:.2f}, {within[1]:.2f})"
    return "principal point", text, f"add {x:+.2f} to cx and {y:+.2f} to cy", figures
