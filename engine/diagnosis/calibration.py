"""How far off are the lens, the depth unit and the ray length? A robust least-squares fit to all reprojected depth.

Every point that another view shows nearly where it is expected is one equation of the fit. An error in one frame's pose
affects all of its pairs, so the uncertainty counts frames and not points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .looks import Floats
from .reprojection import Assumption, Views

_PARAMETERS = ("unit", "focal", "aspect", "x", "y", "ray")
_STEPS = np.array([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 2e-3])
"""Step of each parameter for the slopes. It hardly changes which points agree."""
_PRIOR = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 1.0])
"""The expected deviation of each. It decides where views say nothing: cameras at one height leave fy open."""
_ROUNDS = 8
_LEAST_TERMS = 200
_FINEST = 2e-4
"""Relative error of depth that rounding to millimetres makes. Smaller ones cannot be measured."""
_STEEPEST = 5.0
"""Largest slope of a point on a surface. A larger one means that the point crossed an edge."""


class Calibration(NamedTuple):
    """``values`` float64 [6] relative to the assumption, in the order of ``_PARAMETERS``, with their standard errors.

    They are the logarithms of the factors of depth, of the focal lengths and of fx alone, the principal point's shift
    in shares of width and height, and the part of the ray's length that is in depth.
    """

    values: Floats
    deviations: Floats

    def of(self, name: str) -> float:
        """One of the values, by its name."""
        return float(self.values[_PARAMETERS.index(name)])

    def deviation(self, name: str) -> float:
        """The standard error of one of the values."""
        return float(self.deviations[_PARAMETERS.index(name)])

    def is_sure_of(self, name: str, least: float, sigmas: float = 5.0) -> bool:
        """Whether a value differs from 0 by at least ``least`` and by at least ``sigmas`` standard errors."""
        return abs(self.of(name)) >= max(least, sigmas * self.deviation(name))


class _Linear(NamedTuple):
    """``errors`` [n], their ``slopes`` [n, p] by parameter, ``weights`` [n], and the two ``frames`` [n, 2] of each."""

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
    free: tuple[str, ...] = _PARAMETERS,
    points: int | None = None,
) -> Calibration | None:
    """Fit the ``free`` parameters. None where too few points agree."""
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


def _linearised(
    views: Views, pairs: NDArray[np.int64], at: Assumption, columns: list[int], points: int | None
) -> _Linear | None:
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
    """The step [p] of weighted least squares from ``values`` [p] with precisions ``prior`` [p], and its errors [p].

    Errors within a frame are correlated, so the errors are summed by frame.
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
