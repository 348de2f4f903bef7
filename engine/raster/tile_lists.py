"""Lists the Gaussians of each tile, by all workers, or by one where there are few."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine import memory
from ..machine.threads import parallel_for
from .records import TILE
from .tile_steps import DIGITS, LOOKS, PROGRESS, run_tile_steps

WORTH_LISTING_TOGETHER = 1000
"""Fewer Gaussians, and pairs of Gaussian and tile, than this are listed by one worker: the others would come too
late."""
WORTH_SORTING_TOGETHER = 10_000
"""Fewer visible Gaussians than this are sorted by one worker: two would wait for what the other has just written."""


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
    """What ``project`` left: ``boxes`` int32 [N, 4] in tiles, ``depths`` float32 [N] of the visible, and ``counts``
    int64 [portions, 2] of the visible Gaussians in each portion, and of the pairs of Gaussian and tile."""

    boxes: NDArray[Any]
    depths: NDArray[Any]
    counts: NDArray[Any]


def list_tiles(workers: int, projected: Projected, width: int, height: int) -> PairLists:
    """Of an image of so many pixels."""
    shown, pairs = projected.counts.sum(axis=0).tolist()
    columns, rows = -(-width // TILE), -(-height // TILE)
    listing = workers if max(pairs, len(projected.boxes)) >= WORTH_LISTING_TOGETHER else 1
    sorting = listing if shown >= WORTH_SORTING_TOGETHER else 1
    slots, starts, tile_ids, tile_slots = memory.several(
        (len(projected.boxes) + 1, np.int64), (columns * rows + 1, np.int64), (pairs, np.int32), (pairs, np.int32)
    )
    # apart from what is kept
    keys, ids, spare_keys, spare_ids, digits, digit_starts, histograms = memory.several(
        (shown, np.uint32),
        (shown, np.int32),
        (shown, np.uint32),
        (shown, np.int32),
        ((sorting, DIGITS), np.int64),
        (DIGITS + 1, np.int64),
        ((listing, columns * rows), np.int64),
    )
    longest = np.zeros(1, np.int64)
    parallel_for(
        listing,
        run_tile_steps,
        np.zeros(PROGRESS, np.int64),
        LOOKS,
        projected.boxes,
        projected.depths.view(np.uint32),
        projected.counts,
        slots,
        keys,
        ids,
        spare_keys,
        spare_ids,
        digits,
        digit_starts,
        columns,
        histograms,
        starts,
        tile_ids,
        tile_slots,
        longest,
    )
    return PairLists(slots, starts, tile_ids, tile_slots, int(longest[0]))
