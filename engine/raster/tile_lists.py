"""Lists the Gaussians of each tile, by all workers, or by one where there are few."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine import memory
from ..machine.crew import share
from .records import TILE
from .tiles import (
    DIGIT_BITS,
    DIGIT_PASSES,
    DIGITS,
    count_digits,
    count_tiles,
    deal_digits,
    deal_tiles,
    list_alone,
    list_visible,
    running_starts,
)

WORTH_SHARING = 20_000
"""Fewer pairs of Gaussian and tile than this are listed by one worker in one call: nine calls of all workers, with
Python between them, take longer."""


@dataclass(frozen=True, eq=False)
class PairLists:
    """Which Gaussians each tile draws, and where their gradients go.

    ``slots`` int64 [N + 1] and ``starts`` int64 [tiles + 1]: each Gaussian's and each tile's first place among all T
    pairs of them; ``ids`` and ``tile_slots`` int32 [T], tile after tile: the Gaussian, and its place. ``longest``: the
    Gaussians in the longest list.
    """

    slots: NDArray[Any]
    starts: NDArray[Any]
    ids: NDArray[Any]
    tile_slots: NDArray[Any]
    longest: int

    def blenders(self, workers: int) -> int:
        """A worker has room for the longest list: no more of them than there are such lists to do."""
        return min(workers, max(1, -(-len(self.ids) // max(1, self.longest))))


@dataclass(frozen=True, eq=False)
class Projected:
    """What ``project`` left: ``records`` float32 [N, RECORD], ``boxes`` int32 [N, 4] in tiles, and ``counts`` int64
    [workers, 2] of the visible Gaussians in each worker's share, and of the pairs of Gaussian and tile."""

    records: NDArray[Any]
    boxes: NDArray[Any]
    counts: NDArray[Any]


def list_tiles(
    workers: int, projected: Projected, width: int, height: int, centres: NDArray[Any], visible: NDArray[Any]
) -> PairLists:
    """Of an image of so many pixels. Fills ``centres`` float32 [N, 2] and ``visible`` bool [N]."""
    shown, touched = (int(total) for total in projected.counts.sum(0))
    columns, rows = -(-width // TILE), -(-height // TILE)
    listing = workers if touched >= WORTH_SHARING else 1
    slots = memory.empty(len(projected.boxes) + 1, np.int64)
    keys, spare_keys = memory.empty((2, shown), np.uint32)
    ids, spare_ids = memory.empty((2, shown), np.int32)
    starts = memory.empty(columns * rows + 1, np.int64)
    histograms = memory.empty((listing, columns * rows), np.int64)
    tile_ids, tile_slots = memory.empty((2, touched), np.int32)
    seen = (projected.boxes, projected.records, projected.records.view(np.uint32))
    sorting = (keys, ids, spare_keys, spare_ids)
    dealing = (columns, histograms, starts, tile_ids, tile_slots)
    digits = (memory.empty((listing, DIGITS), np.int64), memory.empty(DIGITS + 1, np.int64))
    if listing == 1:
        zeros, found = np.zeros((2, 1), np.int64)
        share(1, list_alone, *seen, zeros, found, slots, centres, visible, *sorting, *digits, *dealing)
        longest = int(found[0])
    else:
        before = np.cumsum(projected.counts, 0) - projected.counts
        places, slot_starts = np.ascontiguousarray(before.T)
        share(workers, list_visible, *seen, places, slot_starts, keys, ids, slots, centres, visible)
        order = _sort_by_depth(workers, *sorting, *digits)
        longest = _deal(workers, order, projected.boxes, slots, *dealing)
    return PairLists(slots, starts, tile_ids, tile_slots, longest)


def _sort_by_depth(
    workers: int,
    keys: NDArray[Any],
    ids: NDArray[Any],
    spare_keys: NDArray[Any],
    spare_ids: NDArray[Any],
    histograms: NDArray[Any],
    starts: NDArray[Any],
) -> NDArray[Any]:
    """The visible Gaussians int32 [V], front to back."""
    for digit_pass in range(DIGIT_PASSES):
        shift = np.uint32(DIGIT_BITS * digit_pass)
        share(workers, count_digits, keys, shift, histograms)
        running_starts(histograms, starts)
        share(workers, deal_digits, keys, ids, shift, histograms, spare_keys, spare_ids)
        keys, spare_keys = spare_keys, keys
        ids, spare_ids = spare_ids, ids
    return ids


def _deal(
    workers: int,
    order: NDArray[Any],
    boxes: NDArray[Any],
    slots: NDArray[Any],
    columns: int,
    histograms: NDArray[Any],
    starts: NDArray[Any],
    tile_ids: NDArray[Any],
    tile_slots: NDArray[Any],
) -> int:
    """Fills ``starts``, ``tile_ids`` and ``tile_slots``; the length of the longest list."""
    share(workers, count_tiles, order, boxes, columns, histograms)
    longest: int = running_starts(histograms, starts)
    share(workers, deal_tiles, order, boxes, slots, columns, histograms, tile_ids, tile_slots)
    return longest
