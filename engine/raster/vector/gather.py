"""Label gradients of a Gaussian's tiles, added in order, sixteen at a time. The same steps as its
readable twin, in ``engine/raster/gather.py``."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, part
from ...machine.shared import shared
from ...machine.vectors import get, lane_numbers, load, spread, store, store_some
from ..gather import gather_geometry
from ..records import TILE, padded_channels

F = np.float32
ZERO = F(0.0)


@part
def gather_labels(
    worker: int, workers: int, slots: Array, touched: Array, slot_labels: Array, channels: int, d_labels: Array
) -> None:
    """A worker's share of the label gradients of all N Gaussians, zeros included: d_labels [N * C]."""
    count = slots.shape[0] - 1
    padded = padded_channels(channels)
    end = count * (worker + 1) // workers
    in_tail = lane_numbers() < spread(F(channels - padded + TILE))
    for i in range(count * worker // workers, end):
        first, last = get(slots, i), get(slots, i + 1)
        for c in range(0, padded, TILE):
            total = spread(ZERO)
            for slot in range(first, last):
                if get(touched, slot) != 0:
                    total = total + load(slot_labels, slot * padded + c)
            at = i * channels + c
            if at + TILE <= end * channels:
                store(d_labels, at, total)  # what is too much, the next Gaussians write over
            else:
                store_some(d_labels, at, total, in_tail)


@shared
def gather(worker: int, workers: int, slots: Array, touched: Array, labels: Any, geometry: Any) -> None:
    """As its plain twin."""
    gather_geometry(worker, workers, slots, touched, *geometry)
    gather_labels(worker, workers, slots, touched, *labels)
