"""Find the distinct rows of an array of integers, such as the cells of a grid that points lie in."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import NDArray

MOST_CELLS = 2**62
"""The most cells of the box around all rows: each cell's number must fit an int64."""


def distinct_rows(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct rows of ``rows`` int64 [N, D] in lexical order, int64 [M, D], and the index of each row among
    them, int64 [N]. The same as ``numpy.unique`` with ``axis=0``, ten times as fast: a row is sorted as one number."""
    lowest, highest = (rows.min(axis=0), rows.max(axis=0)) if len(rows) else (np.zeros(rows.shape[1], int),) * 2
    # Python's integers, as the product may exceed an int64
    extent = [high - low + 1 for low, high in zip(lowest.tolist(), highest.tolist(), strict=True)]
    if prod(extent) > MOST_CELLS:
        distinct, index = np.unique(rows, axis=0, return_inverse=True)
        return distinct, index.reshape(-1)
    numbers, index = np.unique(np.ravel_multi_index(tuple((rows - lowest).T), extent), return_inverse=True)
    return np.stack(np.unravel_index(numbers, extent), axis=1) + lowest, index
