"""The nearest of some points. Blender's Python has numpy, but no k-d tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_PAIRS = 1 << 22
"""The largest number of distances held at a time."""
_MANY = 1 << 27
"""The number of pairs from which importing a k-d tree pays off, where there is one."""


def nearest(
    queries: NDArray[np.floating], points: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The index of the nearest of ``points`` [N, 3], at least one, to each of ``queries`` [Q, 3], int64 [Q], and its
    distance, float64 [Q]."""
    if len(queries) * len(points) > _MANY:
        try:
            from scipy.spatial import cKDTree
        except ImportError:
            pass
        else:
            far, index = cKDTree(points).query(queries)
            return np.asarray(index, np.int64), np.asarray(far, np.float64)
    middle = points.mean(axis=0, dtype=np.float64)
    near = (points - middle).astype(np.float64)
    squared = (near * near).sum(axis=1)
    found, least = np.empty(len(queries), np.int64), np.empty(len(queries), np.float64)
    step = max(1, _PAIRS // len(points))
    for start in range(0, len(queries), step):
        some = (queries[start : start + step] - middle).astype(np.float64)
        distance = squared - 2.0 * (some @ near.T)  # without the queries' own squares, which do not change the order
        rows = distance.argmin(axis=1)
        found[start : start + step] = rows
        least[start : start + step] = distance[np.arange(len(some)), rows] + (some * some).sum(axis=1)
    return found, np.sqrt(np.maximum(least, 0.0))
