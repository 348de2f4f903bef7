"""Linear assignment of a view's instances to the model's slots (paper, section "Loss Functions", instance
loss).

M-hat_m2f: ids of a machine mask mean nothing across views, so they are matched with what the model shows now,
as Panoptic Lifting does: by the mean probability of each slot over the instance's pixels (the paper's text
says IoU).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def best_slots(mean: NDArray[np.float64]) -> NDArray[np.int32]:
    """Slot of each instance, int32 [I], -1 for those that get none: the assignment of largest sum of ``mean`` [I, S],
    the mean probabilities of the slots over the instances' pixels."""
    slot_of_row = np.full(len(mean), -1, np.int32)
    rows, slots = linear_sum_assignment(-mean)
    slot_of_row[rows] = slots
    return slot_of_row
