"""Label gradients of a Gaussian's tiles, added in order, sixteen at a time. The same steps as its
readable twin, in ``engine/raster/gather.py``."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, parallel_kernel, part
from ...machine.vectors import get, lane_numbers, load, spread, store, store_some
from ..gather import gather_geometry
from ..portions import portion_count, take_portion
from ..records import TILE, padded_channels

F = np.float32
ZERO = F(0.0)


@part
def gather_labels(
    first: int, end: int, slots: Array, touched: Array, slot_labels: Array, channels: int, d_labels: Array
) -> None:
    """The label gradients of the Gaussians from ``first`` to before ``end``, zeros included: of d_labels [N * C]."""
    padded = padded_channels(channels)
    in_tail = lane_numbers() < spread(F(channels - padded + TILE))
    for i in range(first, end):
        first_slot, last_slot = get(slots, i), get(slots, i + 1)
        for c in range(0, padded, TILE):
            total = spread(ZERO)
            for slot in range(first_slot, last_slot):
                if get(touched, slot) != 0:
                    total = total + load(slot_labels, slot * padded + c)
            at = i * channels + c
            if at + TILE <= end * channels:
                store(d_labels, at, total)  # what is too much, the next Gaussians write over
            else:
                store_some(d_labels, at, total, in_tail)


@parallel_kernel
def gather(
    worker: int, workers: int, next_portion: Array, slots: Array, touched: Array, labels: Any, geometry: Any
) -> None:
    """As its plain twin."""
    count = slots.shape[0] - 1
    portions = portion_count(count)
    first, end = take_portion(next_portion, portions, count)
    while first < end:
        gather_geometry(worker, first, end, slots, touched, *geometry)
        gather_labels(first, end, slots, touched, *labels)
        first, end = take_portion(next_portion, portions, count)
