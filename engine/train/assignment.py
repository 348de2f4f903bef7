"""Linear assignment of a view's instances to the model's slots in each step. What never changes about a view is
computed once.

The cost of (instance, slot) is minus the mean probability of the slot over the instance's pixels; the Hungarian
algorithm finds the assignment. If there are more instances than slots, some get none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ..machine.compiled import Array, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from ..scene import distinct_ids
from .label_losses import TINY

NO_SLOT = -1
ONE, LEAST = np.float32(1), np.float32(TINY)
CHUNK = 8192
"""Pixels that a thread takes at once. Chunks depend only on the number of pixels, so sums over them have the same
bits however many threads there are."""


@dataclass(frozen=True, eq=False)
class ThingSegments:
    """The thing segments of a view's input mask: ``row`` int32 [H, W] is the number of a pixel's segment, -1 = none;
    ``pixels`` int64 [I] is the number of pixels of each segment."""

    row: NDArray[np.int32]
    pixels: NDArray[np.int64]

    @classmethod
    def of(cls, ids: NDArray[np.integer]) -> ThingSegments:
        """The segments with these ids [H, W], 0 = none."""
        present, pixels = distinct_ids(np.asarray(ids, np.int32))
        row = np.searchsorted(present, ids).astype(np.int32)
        if len(present) and present[0] == 0:  # the smallest id, so it is first
            return cls(row - np.int32(1), pixels[1:])
        return cls(row, pixels)


def assigned_slots(
    coverage: torch.Tensor, alpha: torch.Tensor, first: int, things: ThingSegments, no_object: int | None = None
) -> torch.Tensor:
    """The target slot of each pixel, int16 [H, W], -1 where there is none.

    ``coverage`` float32 [H, W, C] holds the blended slot probabilities from channel ``first`` on; divided by ``alpha``
    [H, W] they are probabilities. No thing is assigned to the slot ``no_object``.
    """
    slots, segments = coverage.shape[-1] - first, len(things.pixels)
    slot_of_segment = np.full(segments + 1, NO_SLOT, np.int16)
    if slots and segments:
        flat = coverage.detach().contiguous().numpy().reshape(-1, coverage.shape[-1])
        sums = np.zeros((-(-len(flat) // CHUNK), segments, slots))
        opaque, row = alpha.detach().numpy().reshape(-1), things.row.reshape(-1)
        parallel_for(worker_count(), add_slots, flat, opaque, first, row, sums)
        mean = sums.sum(axis=0) / things.pixels[:, None]
        able = [slot for slot in range(slots) if slot != no_object]
        rows, columns = linear_sum_assignment(-mean[:, able])
        slot_of_segment[rows] = np.array(able, np.int16)[columns]
    return torch.from_numpy(slot_of_segment[things.row])  # row -1 is the last entry: no slot


@parallel_kernel
def add_slots(worker: int, workers: int, coverage: Array, alpha: Array, first: int, row: Array, sums: Array) -> None:
    """Add the slot probabilities of every ``workers``-th chunk of pixels, by segment, to ``sums`` float64
    [chunks, I, S]."""
    for chunk in range(worker, len(sums), workers):
        for pixel in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(row))):
            if row[pixel] < 0:
                continue
            share_of_alpha = ONE / (alpha[pixel] + LEAST)
            shown, total = coverage[pixel, first:], sums[chunk, row[pixel]]  # inner loops over whole arrays are fastest
            for slot in range(len(total)):
                total[slot] += shown[slot] * share_of_alpha
