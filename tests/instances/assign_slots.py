"""Linear assignment in plain NumPy: the oracle of ``engine.train.label_losses.assigned_slots``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def assign_slots(probabilities: NDArray[np.floating], instance_ids: NDArray[np.integer]) -> NDArray[np.int32]:
    """Target slot of each pixel, int32 [...], -1 where there is no supervision.

    ``probabilities`` float [..., S] are the rendered slot probabilities, ``instance_ids`` int [...] the
    input mask's instances (0 = none). Cost of (instance, slot) = -mean probability; solved by the Hungarian
    algorithm. Instances beyond the number of slots get -1.
    """
    if probabilities.shape[:-1] != instance_ids.shape:
        raise ValueError(f"probabilities {probabilities.shape} do not fit ids {instance_ids.shape}")
    target = np.full(instance_ids.shape, -1, np.int32)
    inside = instance_ids != 0
    ids, row = np.unique(instance_ids[inside], return_inverse=True)
    if not len(ids) or not probabilities.shape[-1]:
        return target
    row = row.reshape(-1)
    shown = probabilities[inside].astype(np.float64)
    count = np.bincount(row, minlength=len(ids))
    mean = np.column_stack([np.bincount(row, column, len(ids)) / count for column in shown.T])
    slot_of_row = np.full(len(mean), -1, np.int32)
    rows, slots = linear_sum_assignment(-mean)
    slot_of_row[rows] = slots
    target[inside] = slot_of_row[row]
    return target
