"""Greedy joining of masks by the summed agreement of the views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def join(weight: NDArray[np.floating]) -> NDArray[np.int64]:
    """Greedy joining of the pair with the greatest summed weight while it is positive: the cluster of each
    row, int64 [M], named by its lowest row. ``weight`` float [M, M], symmetric. Ties go to the lower rows.
    """
    weight = np.array(weight, np.float64)
    np.fill_diagonal(weight, -np.inf)
    cluster = np.arange(len(weight))
    partner = weight.argmax(1)
    best = weight[cluster, partner] if len(weight) else np.zeros(0)
    while len(weight):
        i = int(best.argmax())
        if best[i] <= 1e-9:
            break
        i, j = sorted((i, int(partner[i])))
        cluster[cluster == j] = i
        joined = weight[i] + weight[j]
        weight[i], weight[:, i] = joined, joined
        weight[j], weight[:, j] = -np.inf, -np.inf
        best[j] = -np.inf
        # Rows that had i or j as partner look again; others only have to look at what i has become.
        for row in np.flatnonzero((partner == i) | (partner == j) | (np.arange(len(weight)) == i)):
            partner[row] = weight[row].argmax()
            best[row] = weight[row, partner[row]]
        better = (joined > best) | ((joined == best) & (i < partner))
        better[[i, j]] = False
        partner[better], best[better] = i, joined[better]
    return cluster
