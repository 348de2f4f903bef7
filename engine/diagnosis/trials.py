"""Which assumption about a scene's numbers makes its views agree best? Each is tried on the same points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .calibration import calibrate, moved
from .reprojection import Assumption, Floats, Views

UNITS = (1000.0, 100.0, 10.0, 6.5535, 5.0, 4.0, 2.54, 2.0, 1.6, 1.3107, 0.76295, 0.625, 0.5, 0.393701, 0.25, 0.2,
         1 / 6.5535, 0.1, 0.01, 0.001)  # fmt: skip
"""Metres in place of millimetres, 5000, 6553.5 or 4000 steps a metre in place of 1000, inches; and steps between."""
_ROUND = 0.02
"""Logarithm: a fitted unit this close to a known one is that one, if views agree as well with it."""
_AS_WELL = 0.995
_SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
_FOCALS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.12, 1.25, 1.45, 1.7, 2.0)
_POINTS = 150
_BETTER = 1.15
"""How many times as well views must agree under another assumption for it to be preferred, beside ..."""
_CERTAIN = 5.0
"""... the frames' mean gain in its standard errors. True scenes have no better assumption at all."""
_MOST_CAUSES = 4
_POOR = 0.4
"""Of what two views see: where fewer agree, something is wrong that may need two causes to be explained."""
POSES = ("inverted", "opengl", "inverted opengl")
_ASIDE = 0.1
_KINDS_COMPARED = 4


class Trial(NamedTuple):
    """A ``cause`` and the assumption that takes it into account. ``free``: what is fitted when it is the best."""

    cause: str
    assumed: Assumption
    free: tuple[str, ...] = ()


class Agreement(NamedTuple):
    """``by_frame`` float64 [F]: the mean agreement of each look's points with the views they were carried into, 0..1.

    ``mean`` is that of all points, ``seen`` the share of points where the other view shows depth, ``share`` the share
    of these that agree within 5 %, ``error`` the median relative error of those.
    """

    by_frame: Floats
    mean: float
    seen: float
    share: float
    error: float


class Found(NamedTuple):
    """A cause that was found: the assumption with it, and how views agree without it and with it."""

    cause: str
    assumed: Assumption
    before: Agreement
    after: Agreement


def agreement(views: Views, pairs: NDArray[np.int64], assumed: Assumption) -> Agreement:
    """How well the looks agree under an assumption."""
    comparison = views.compare(pairs, assumed, _POINTS)
    known = comparison.known.sum(1).astype(np.float64)
    agrees = comparison.agrees.sum(1)
    by_frame, points = np.zeros(len(views.looks)), np.zeros(len(views.looks))
    for column in (0, 1):
        np.add.at(by_frame, pairs[:, column], agrees)
        np.add.at(points, pairs[:, column], known)
    seen = np.isfinite(comparison.error)
    errors = np.abs(comparison.error[comparison.agrees > 0.0])
    return Agreement(
        by_frame=by_frame / np.maximum(points, 1.0),
        mean=float(agrees.sum() / max(known.sum(), 1.0)),
        seen=float(seen.sum() / max(known.sum(), 1.0)),
        share=float((comparison.agrees > 0.0).sum() / max(seen.sum(), 1)),
        error=float(np.median(errors)) if len(errors) else float("nan"),
    )


def find_causes(views: Views, pairs: NDArray[np.int64]) -> tuple[list[Found], Assumption]:
    """What is wrong with the numbers of a scene, one cause after the other, and the assumption with all of them."""
    assumed, found = Assumption(), list[Found]()
    before = agreement(views, pairs, assumed)
    for _ in range(_MOST_CAUSES):
        best = _best(views, pairs, assumed, before, {each.cause for each in found})
        if best is None:
            break
        found.append(best)
        assumed, before = best.assumed, best.after
    if not found and before.share < _POOR:
        found = _two_at_once(views, pairs, before)
        assumed = found[-1].assumed if found else assumed
    return found, assumed


def _two_at_once(views: Views, pairs: NDArray[np.int64], before: Agreement) -> list[Found]:
    """Poses and another number may both be wrong, so that either alone makes nothing better."""
    best: tuple[Found, Found] | None = None
    for pose in (trial for trial in _trials(views, Assumption()) if trial.cause in POSES):
        found = _best(views, pairs, pose.assumed, before, {*POSES})
        if found is not None and (best is None or found.after.mean > best[1].after.mean):
            best = Found(pose.cause, pose.assumed, before, found.after), found
    return [] if best is None else [*best]


def is_better(after: Agreement, before: Agreement) -> bool:
    """Whether views agree clearly better: by a sixth, and so that chance is out of the question."""
    gains = after.by_frame - before.by_frame
    error = float(gains.std(ddof=1)) / np.sqrt(len(gains)) if len(gains) > 1 else np.inf
    return after.mean > _BETTER * before.mean and float(gains.mean()) > _CERTAIN * max(error, 1e-9)


def _best(
    views: Views, pairs: NDArray[np.int64], assumed: Assumption, before: Agreement, done: set[str]
) -> Found | None:
    tried = [
        (agreement(views, pairs, trial.assumed), trial) for trial in _trials(views, assumed) if trial.cause not in done
    ]
    best_of: dict[str, tuple[Agreement, Trial]] = {}
    for after, trial in tried:
        if trial.cause not in best_of or after.mean > best_of[trial.cause][0].mean:
            best_of[trial.cause] = (after, trial)
    leading = sorted(best_of.values(), key=lambda each: -each[0].mean)[:_KINDS_COMPARED]
    fitted = [_fitted(views, pairs, after, trial) for after, trial in leading if after.mean > before.mean]
    if not fitted:
        return None
    after, trial = max(fitted, key=lambda each: each[0].mean)
    return Found(trial.cause, trial.assumed, before, after) if is_better(after, before) else None


def _fitted(views: Views, pairs: NDArray[np.int64], after: Agreement, trial: Trial) -> tuple[Agreement, Trial]:
    """A trial with its free parameters fitted, where that makes it better."""
    calibration = calibrate(views, pairs, trial.assumed, trial.free, _POINTS) if trial.free else None
    if calibration is None:
        return after, trial
    refined = trial._replace(assumed=moved(trial.assumed, calibration.values))
    again = agreement(views, pairs, refined.assumed)
    return (again, refined) if again.mean * _AS_WELL > after.mean else (after, trial)


def _trials(views: Views, now: Assumption) -> Iterator[Trial]:
    yield Trial("inverted", now._replace(inverted=not now.inverted))
    yield Trial("opengl", now._replace(opengl=not now.opengl))
    yield Trial("inverted opengl", now._replace(inverted=not now.inverted, opengl=not now.opengl))
    for unit in UNITS:
        yield Trial("unit", now._replace(unit=now.unit * unit), ("unit",))
    yield Trial("ray", now._replace(ray=now.ray + 1.0))
    yield Trial("not ray", now._replace(ray=now.ray - 1.0))
    lens = views.lens_of(now)
    if np.abs(views.size[:, 0] * lens[:, 0] / (views.size[:, 1] * lens[:, 1]) - 1.0).max() > 0.02:
        yield Trial("swapped", now._replace(swapped=not now.swapped))
    middle = np.median(lens[:, 2:], axis=0)
    scales = {*_SCALES, *((0.5 / middle).tolist() if np.abs(middle - 0.5).max() > _ASIDE else ())}
    for scale in sorted(scales):
        yield Trial("lens size", now._replace(lens_scale=now.lens_scale * scale))
    for focal in _FOCALS:
        yield Trial("focal", now._replace(focal=now.focal * focal), ("focal",))
    if np.abs(middle - 0.5).max() > _ASIDE / 2:
        yield Trial("centre", now._replace(centred=True, shift=(0.0, 0.0)), ("x", "y"))
