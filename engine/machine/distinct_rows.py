"""The distinct rows of an array of integers, such as the cells of a grid that points lie in."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import NDArray

MOST_PLACES = 2**62
"""Of the box around all rows, so that the number of each place is an int64."""


def distinct_rows(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The distinct rows of ``rows`` int64 [N, D] in lexical order, int64 [M, D]; and the place of each row among
    them, int64 [N].

    As ``numpy.unique`` with ``axis=0``, in a tenth of its time, as one number is sorted for each row.
    """
    lowest, highest = (rows.min(axis=0), rows.max(axis=0)) if len(rows) else (np.zeros(rows.shape[1], int),) * 2
    extent = [high - low + 1 for low, high in zip(lowest.tolist(), highest.tolist(), strict=True)]
    if prod(extent) > MOST_PLACES:
        distinct, place = np.unique(rows, axis=0, return_inverse=True)
        return distinct, place.reshape(-1)
    numbers, place = np.unique(np.ravel_multi_index(tuple((rows - lowest).T), extent), return_inverse=True)
    return np.stack(np.unravel_index(numbers, extent), axis=1) + lowest, place
