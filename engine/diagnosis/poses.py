"""What pairs of views say about the poses of single frames: drift over time, and frames whose pose is off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .reprojection import Assumption, Floats, Views

_WIDE = 0.15
"""Of the depth: what is further off is another surface."""
_LEAST_POINTS = 40
_QUANTILE = 0.3
"""Of the distances of a pair: some points of any two views lie on surfaces that one of them alone sees."""
_LEAST_PAIRS, _LEAST_LAGS, _LEAST_EACH = 30, 6, 8
_NEAR = 3
_HALF, _ENOUGH = 0.5, 0.2


class Drift(NamedTuple):
    """How far the surfaces of two looks are apart, by the frames between the looks.

    ``near`` and ``far``: metres, the medians of the pairs of neighbours and of those at least half as far apart in
    time as any that see the same.
    ``certainty``: the rank correlation of distance and time, in its standard errors for so many looks. ``lags`` and
    ``distances`` float64 [P] are those of the pairs.
    """

    near: float
    far: float
    certainty: float
    lags: Floats
    distances: Floats


def surface_distances(views: Views, pairs: NDArray[np.int64], assumed: Assumption) -> Floats:
    """How far, in metres along the normal, the surfaces are apart that both looks of a pair see, float64 [P]; nan where
    they see too little in common.
    """
    lens, poses = views.lens_of(assumed), views.poses_of(assumed)
    world, known = views.world_points(assumed, lens, poses)
    found = np.full(len(pairs), np.nan)
    for row, (one, other) in enumerate(pairs.tolist()):
        local = (world[one][known[one]] - poses[other, :3, 3]) @ poses[other, :3, :3]
        surface = views.surface_at(other, local, assumed, lens[other])
        distance = np.abs(surface.distance)
        near = np.isfinite(distance) & (distance < _WIDE * np.abs(local[:, 2]))
        if near.sum() >= _LEAST_POINTS:
            found[row] = np.quantile(distance[near], _QUANTILE)
    return found


def measure_drift(distances: Floats, lags: Floats, looks: int) -> Drift | None:
    """How the distances of pairs go with the frames between them, float64 [P] each; None with too few pairs."""
    good = np.isfinite(distances)
    distance, lag = distances[good], lags[good]
    if len(lag) < _LEAST_PAIRS or len(np.unique(lag)) < _LEAST_LAGS:
        return None
    beside, apart = lag <= _NEAR, lag >= lag.max() / 2.0
    if beside.sum() < _LEAST_EACH or apart.sum() < _LEAST_EACH:
        return None
    correlation = float(np.corrcoef(_ranks(distance), _ranks(lag))[0, 1])
    error = float(np.sqrt(max(1.0 - correlation**2, 1e-6) / max(looks - 2, 1)))
    near, far = np.median(distance[beside]), np.median(distance[apart])
    return Drift(float(near), float(far), correlation / error, lag, distance)


def _ranks(values: Floats) -> Floats:
    """The place of each value in their order; equal values share the mean of their places."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts - 1) / 2.0)[inverse]


def misplaced_looks(views: Views, pairs: NDArray[np.int64], assumed: Assumption) -> list[int]:
    """Looks (rows) that agree with none of those beside them, while these agree with each other across them."""
    comparison = views.compare(pairs, assumed)
    share = comparison.agrees.sum(1) / np.maximum(comparison.known.sum(1), 1)
    by_pair = {(min(pair), max(pair)): float(value) for pair, value in zip(pairs.tolist(), share, strict=True)}
    found = []
    for row in range(1, len(views.looks) - 1):
        near = [(a, b) for a in range(row - _NEAR, row + 1) for b in range(row, row + _NEAR + 1) if 0 < b - a <= _NEAR]
        own = max((by_pair.get(pair, 0.0) for pair in near if row in pair), default=0.0)
        across = max((by_pair.get(pair, 0.0) for pair in near if row not in pair), default=0.0)
        if across > _ENOUGH and own < _HALF * across:
            found.append(row)
    return found
