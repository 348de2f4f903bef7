"""Find the assumption about a scene's numbers under which its views agree best. Each is tried on the same points. How
far off the lens, the depth unit and the ray length are follows from a robust least-squares fit to all reprojected
depth. Every point that another view sees near the expected place is one equation of the fit. An error in one frame's
pose affects all of its pairs, so the uncertainty counts frames and not points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import made_ahead
from .reprojection import Assumption, Floats, Pairs, Views

_PARAMETERS = ("unit", "focal", "aspect", "x", "y", "ray")
_STEPS = np.array([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 2e-3])
"""Step of each parameter for the slopes. It hardly changes which points agree."""
_PRIOR = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 1.0])
"""The expected deviation of each. It decides where views say nothing: cameras at one height leave fy open."""
_ROUNDS = 8
_LEAST_TERMS = 200
_FINEST = 2e-4  # relative depth error caused by rounding to millimetres; smaller ones cannot be measured
_STEEPEST = 5.0  # largest slope of a point on a surface; a larger one means that the point crossed an edge


class Calibration(NamedTuple):
    """The fitted corrections. ``values`` float64 [6] are relative to the assumption, in the order of ``_PARAMETERS``,
    with their standard errors, ``deviations``: the logarithms of the factors of depth, of the focal lengths and of fx
    alone, the principal point's shift in fractions of width and height, and the part of the ray's length that is in
    depth."""

    values: Floats
    deviations: Floats

    def of(self, name: str) -> float:
        """Return one of the values, by its name, such as "unit"."""
        return float(self.values[_PARAMETERS.index(name)])

    def deviation(self, name: str) -> float:
        """Return the standard error of one of the values, by its name."""
        return float(self.deviations[_PARAMETERS.index(name)])

    def is_sure_of(self, name: str, least: float) -> bool:
        """Whether a value differs from 0 by at least ``least`` and by at least 5 standard errors."""
        return abs(self.of(name)) >= max(least, 5.0 * self.deviation(name))


class _Linear(NamedTuple):
    """The linear equations of the fit: ``errors`` [n], their ``slopes`` [n, p] by parameter, ``weights`` [n], and the
    two ``frames`` [n, 2] of each."""

    errors: Floats
    slopes: Floats
    weights: Floats
    frames: NDArray[np.int64]


def moved(base: Assumption, values: Floats) -> Assumption:
    """Return ``base`` changed by ``values`` [6], fitted corrections in the order of ``_PARAMETERS``."""
    unit, focal, aspect, x, y, ray = values.tolist()
    return base._replace(
        unit=base.unit * float(np.exp(unit)),
        focal=base.focal * float(np.exp(focal)),
        aspect=base.aspect * float(np.exp(aspect)),
        shift=(base.shift[0] + x, base.shift[1] + y),
        ray=base.ray + ray,
    )


def calibrate(
    views: Views, pairs: Pairs, base: Assumption, free: tuple[str, ...] = _PARAMETERS, points: int | None = None
) -> Calibration | None:
    """Fit the ``free`` parameters, from the assumption ``base`` on, to ``points`` points of each frame (None: all).
    Returns None if too few points agree."""
    columns = [_PARAMETERS.index(name) for name in free]
    values, deviations = np.zeros(len(_PARAMETERS)), np.full(len(_PARAMETERS), np.inf)
    for _ in range(_ROUNDS):
        linear = _linearised(views, pairs, moved(base, values), columns, points)
        if linear is None:
            return None
        step, errors = _solve(linear, values[columns], 1.0 / np.square(_PRIOR[columns]))
        values[columns] += step
        deviations[columns] = errors
        if np.abs(step / _STEPS[columns]).max() < 0.05:
            break
    return Calibration(values, deviations)


def _linearised(views: Views, pairs: Pairs, at: Assumption, columns: list[int], points: int | None) -> _Linear | None:
    centre = views.compare(pairs, at, points)
    found = []
    for column in columns:
        step = np.zeros(len(_PARAMETERS))
        step[column] = _STEPS[column]
        after = views.compare(pairs, moved(at, step), points)
        found.append((centre.error - after.error) / _STEPS[column])
    slopes = np.stack(found, -1)
    usable = (centre.agrees > 0.0) & np.isfinite(slopes).all(-1) & (np.abs(slopes) < _STEEPEST).all(-1)
    if usable.sum() < _LEAST_TERMS:
        return None
    frames = pairs[np.nonzero(usable)[0]]
    return _Linear(centre.error[usable], slopes[usable], centre.agrees[usable], frames)


def _solve(linear: _Linear, values: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Solve weighted least squares from ``values`` [p], which tend to 0 with the precisions ``prior`` [p]. Returns the
    step and the standard errors, [p] each."""
    noise = float(np.sqrt((linear.weights * linear.errors**2).sum() / linear.weights.sum()))
    precision = max(noise, _FINEST) ** -2
    weighted = precision * linear.slopes * linear.weights[:, None]
    inverse = np.linalg.inv(linear.slopes.T @ weighted + np.diag(prior))
    step = np.dot(inverse, np.dot(weighted.T, linear.errors) - prior * values)  # the prior pulls them to 0
    scores = weighted * (linear.errors - linear.slopes @ step)[:, None]
    by_frame = np.zeros((int(linear.frames.max()) + 1, len(values)))  # errors within a frame are correlated
    np.add.at(by_frame, linear.frames[:, 0], scores)
    np.add.at(by_frame, linear.frames[:, 1], scores)
    return step, np.sqrt(np.diag(inverse @ (by_frame.T @ by_frame + np.diag(prior)) @ inverse))  # sandwich estimate


_UNITS = (1000.0, 100.0, 10.0, 6.5535, 5.0, 4.0, 2.54, 2.0, 1.6, 1.3107, 0.76295, 0.625, 0.5, 0.393701, 0.25, 0.2,
         1 / 6.5535, 0.1, 0.01, 0.001)  # fmt: skip
"""Factors of depth, for metres read as millimetres, 5000, 6553.5 or 4000 steps per metre read as 1000, and inches."""
_AS_GOOD = 0.995  # a fitted value replaces a tried one where views agree at least this many times as well
_SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
_FOCALS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.12, 1.25, 1.45, 1.7, 2.0)
_POINTS = 150
_BETTER = 1.15  # least factor by which views must agree better under another assumption
_CERTAIN = 5.0  # least mean gain of the frames, in its standard errors
_LENS_CAUSES = ("lens size", "focal")
_ASIDE = 0.1  # of the picture; a principal point farther from the middle may belong to pictures of another size
_KINDS_COMPARED = 4
_RIVAL = 1.05  # least factor by which a cause must explain more than the next, for a scene to be mended by it
_ERROR_LEFT = 0.7
_LEAST_SHARE, _LEAST_OF_ALL = 0.5, 0.15  # least fractions that agree under a cause: of what both views see, and of all
_NEAREST, _FARTHEST = 0.4, 8.0  # metres: bounds of a room's median depth, to which a cause in lengths must lead
_LAGS = (-2, -1, 1, 2)


class Trial(NamedTuple):
    """A ``cause`` to try and what is ``assumed`` then. ``free`` names the values to fit if this trial is best."""

    cause: str
    assumed: Assumption
    free: tuple[str, ...] = ()


class Agreement(NamedTuple):
    """How well views agree. ``by_frame`` float64 [F] is the mean agreement, 0..1, of each frame's points with the other
    frames; ``mean`` is over all points. ``seen`` is the fraction of points where the other frame has depth. Of these,
    ``share`` agree within 5 %, with the median relative error ``error``."""

    by_frame: Floats
    mean: float
    seen: float
    share: float
    error: float


class FoundCause(NamedTuple):
    """A cause that was found, what is ``assumed`` with it, and how well views agree before and after. ``rival`` is a
    cause that explains the scene about as well, None if there is none."""

    cause: str
    assumed: Assumption
    before: Agreement
    after: Agreement
    rival: str | None = None


def agreement(views: Views, pairs: Pairs, assumed: Assumption) -> Agreement:
    """Return how well the frames agree under an assumption."""
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


def is_far_better(after: Agreement, before: Agreement) -> bool:
    """Whether a correction is good enough: ``after`` it, half of what two frames see agrees, and the agreement is 15 %
    better than ``before``, or about as good with 30 % less error."""
    more = after.mean > _BETTER * before.mean
    finer = after.mean >= _AS_GOOD * before.mean and after.error < _ERROR_LEFT * before.error
    return after.share >= _LEAST_SHARE and (more or finer)


def find_cause(views: Views, pairs: Pairs, lens_is_doubtful: bool = False) -> FoundCause | None:
    """Return the cause that explains the numbers of a scene best, None if none makes the views agree clearly better.
    With ``lens_is_doubtful``, a cause in the lens comes before others that explain them about as well."""
    before = agreement(views, pairs, Assumption())
    best_of: dict[str, tuple[Agreement, Trial]] = {}
    trials = [*_trials(views)]
    tried = made_ahead(trials, lambda trial: agreement(views, pairs, trial.assumed))
    for trial, after in zip(trials, tried, strict=True):
        if trial.cause not in best_of or after.mean > best_of[trial.cause][0].mean:
            best_of[trial.cause] = (after, trial)
    leading = sorted(best_of.values(), key=lambda each: -each[0].mean)[:_KINDS_COMPARED]
    fitted = [_fitted(views, pairs, after, trial) for after, trial in leading if after.mean > before.mean]
    if not fitted:
        return None
    best = max(after.mean for after, _ in fitted)

    doubted = _LENS_CAUSES if lens_is_doubtful else ()  # a lens comes first if it explains about as much as the best
    fitted.sort(key=lambda each: (each[1].cause not in doubted or each[0].mean * _RIVAL <= best, -each[0].mean))
    after, trial = fitted[0]
    # Views must agree clearly better: by 15 %, and beyond chance.
    gains = after.by_frame - before.by_frame
    error = float(gains.std(ddof=1)) / np.sqrt(len(gains)) if len(gains) > 1 else np.inf
    is_enough = after.share >= _LEAST_SHARE and after.seen * after.share >= _LEAST_OF_ALL
    is_certain = float(gains.mean()) > _CERTAIN * max(error, 1e-9)
    if not (is_enough and is_certain and after.mean > _BETTER * before.mean):
        return None
    rival = fitted[1][1].cause if len(fitted) > 1 and fitted[1][0].mean * _RIVAL > after.mean else None
    found = FoundCause(trial.cause, trial.assumed, before, after, rival)
    return _whose_lengths(views, found) if trial.cause == "unit" else found


def _whose_lengths(views: Views, found: FoundCause) -> FoundCause:
    """Decide by the sizes of rooms, as views cannot tell, whether depth or poses have the wrong unit. Returns ``found``
    (depth), the same with the cause "length" (poses) or, if both are likely, with "length" as ``rival``."""
    factor = found.assumed.unit
    depth = float(np.median(views.values[views.values > 0.0]))
    is_room, becomes_room = (_NEAREST <= metres <= _FARTHEST for metres in (depth, depth * factor))
    if becomes_room and is_room and abs(np.log10(factor) - round(np.log10(factor))) < 0.02:
        return found._replace(rival="length")
    if becomes_room or not is_room:
        return found
    return found._replace(cause="length", assumed=Assumption(length=1.0 / factor))


def _fitted(views: Views, pairs: Pairs, after: Agreement, trial: Trial) -> tuple[Agreement, Trial]:
    """Fit the free values of ``trial``. Returns the agreement and trial after that, or the old ones if it is worse."""
    calibration = calibrate(views, pairs, trial.assumed, trial.free, _POINTS) if trial.free else None
    if calibration is None:
        return after, trial
    refined = trial._replace(assumed=moved(trial.assumed, calibration.values))
    again = agreement(views, pairs, refined.assumed)
    return (again, refined) if again.mean * _AS_GOOD > after.mean else (after, trial)


def _trials(views: Views) -> Iterator[Trial]:
    yield Trial("inverted", Assumption(inverted=True))
    yield Trial("opengl", Assumption(opengl=True))
    yield Trial("inverted opengl", Assumption(inverted=True, opengl=True))
    for unit in _UNITS:
        yield Trial("unit", Assumption(unit=unit), ("unit",))
    yield Trial("ray", Assumption(ray=1.0))
    for lag in _LAGS:
        yield Trial("lag", Assumption(lag=lag))
    yield Trial("mirrored", Assumption(mirrored=True))
    middle = np.median(views.lens[:, 2:], axis=0)
    scales = {*_SCALES, *((0.5 / middle).tolist() if np.abs(middle - 0.5).max() > _ASIDE else ())}
    for scale in sorted(scales):
        yield Trial("lens size", Assumption(lens_scale=scale))
    for focal in _FOCALS:
        yield Trial("focal", Assumption(focal=focal), ("focal",))
