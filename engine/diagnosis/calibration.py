"""How far off lens, depth unit and ray length are: a robust least-squares fit to all reprojected depth.

Every point that another view shows nearly where it is expected says a little of what would make both agree. Errors of
one frame's pose sit in all of its pairs, so the fit's uncertainty counts frames, not points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .reprojection import Assumption, Floats, Views

PARAMETERS = ("unit", "focal", "aspect", "x", "y", "ray")
_STEPS = np.array([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 2e-3])
"""How far each is moved to see what it does: far less than what changes which points agree."""
_PRIOR = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 1.0])
"""About what each may be off by. It decides where views say nothing: cameras all at one height leave fy open."""
_ROUNDS = 8
_LEAST_TERMS = 200
_FINEST = 2e-4
"""Relative error of depth below which rounding to millimetres hides all."""
_STEEPEST = 5.0


class Calibration(NamedTuple):
    """``values`` float64 [6] beside what was assumed, in the order of ``PARAMETERS``: logarithms of the factors of
    depth, of the focal lengths and of fx alone; the principal point's shift in shares of width and height; the part of
    the ray's length in depth. ``deviations`` are their standard errors.
    """

    values: Floats
    deviations: Floats

    def of(self, name: str) -> float:
        """One of the values, by its name."""
        return float(self.values[PARAMETERS.index(name)])

    def deviation(self, name: str) -> float:
        """The standard error of one of the values."""
        return float(self.deviations[PARAMETERS.index(name)])

    def is_sure_of(self, name: str, least: float, sigmas: float = 5.0) -> bool:
        """Whether a value is at least ``least``, up or down, and so many standard errors."""
        return abs(self.of(name)) >= max(least, sigmas * self.deviation(name))


class _Linear(NamedTuple):
    """Errors [n], what each parameter would take off them [n, p], weights [n], the frames [n, 2] they are between."""

    errors: Floats
    slopes: Floats
    weights: Floats
    frames: NDArray[np.int64]


def moved(base: Assumption, values: Floats) -> Assumption:
    """An assumption that differs from ``base`` by ``values``, as in ``Calibration``."""
    unit, focal, aspect, x, y, ray = values.tolist()
    return base._replace(
        unit=base.unit * float(np.exp(unit)),
        focal=base.focal * float(np.exp(focal)),
        aspect=base.aspect * float(np.exp(aspect)),
        shift=(base.shift[0] + x, base.shift[1] + y),
        ray=base.ray + ray,
    )


def calibrate(
    views: Views,
    pairs: NDArray[np.int64],
    base: Assumption,
    free: tuple[str, ...] = PARAMETERS,
    points: int | None = None,
) -> Calibration | None:
    """Fit the ``free`` parameters; None when too few points agree to say anything."""
    columns = [PARAMETERS.index(name) for name in free]
    values, deviations = np.zeros(len(PARAMETERS)), np.full(len(PARAMETERS), np.inf)
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


def _linearised(
    views: Views, pairs: NDArray[np.int64], at: Assumption, columns: list[int], points: int | None
) -> _Linear | None:
    centre = views.compare(pairs, at, points)
    found = []
    for column in columns:
        step = np.zeros(len(PARAMETERS))
        step[column] = _STEPS[column]
        after = views.compare(pairs, moved(at, step), points)
        found.append((centre.error - after.error) / _STEPS[column])
    slopes = np.stack(found, -1)
    # Where a parameter seems to do much, the point went over an edge.
    usable = (centre.agrees > 0.0) & np.isfinite(slopes).all(-1) & (np.abs(slopes) < _STEEPEST).all(-1)
    if usable.sum() < _LEAST_TERMS:
        return None
    frames = pairs[np.nonzero(usable)[0]]
    return _Linear(centre.error[usable], slopes[usable], centre.agrees[usable], frames)


def _solve(linear: _Linear, values: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """The step of weighted least squares from ``values`` [p], ``prior`` [p] their precisions, and standard errors [p].

    Errors within a frame hang together, so pairs that share one are not independent.
    """
    noise = float(np.sqrt((linear.weights * linear.errors**2).sum() / linear.weights.sum()))
    precision = max(noise, _FINEST) ** -2
    weighted = precision * linear.slopes * linear.weights[:, None]
    inverse = np.linalg.inv(linear.slopes.T @ weighted + np.diag(prior))
    step = np.dot(inverse, np.dot(weighted.T, linear.errors) - prior * values)
    scores = weighted * (linear.errors - linear.slopes @ step)[:, None]
    by_frame = np.zeros((int(linear.frames.max()) + 1, len(values)))
    np.add.at(by_frame, linear.frames[:, 0], scores)
    np.add.at(by_frame, linear.frames[:, 1], scores)
    return step, np.sqrt(np.diag(inverse @ (by_frame.T @ by_frame + np.diag(prior)) @ inverse))
