"""Lists the Gaussians of each tile, by all workers, or by one where there are few."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine import memory
from ..machine.crew import share
from .records import TILE
from .tile_steps import DIGITS, STEPS, UNSHARED, run_tile_steps

WORTH_SHARING = 20_000
"""Fewer Gaussians, and pairs of Gaussian and tile, than this are listed by one worker in one call: a call for every
step, with Python between them, takes longer."""


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
    shown, touched = map(sum, zip(*projected.counts.tolist(), strict=True))
    columns, rows = -(-width // TILE), -(-height // TILE)
    listing = workers if max(touched, len(projected.boxes)) >= WORTH_SHARING else 1
    slots = memory.empty(len(projected.boxes) + 1, np.int64)
    keys, spare_keys = memory.empty((2, shown), np.uint32)
    ids, spare_ids = memory.empty((2, shown), np.int32)
    starts = memory.empty(columns * rows + 1, np.int64)
    tile_ids, tile_slots = memory.empty((2, touched), np.int32)
    longest = np.zeros(1, np.int64)
    arguments = (
        projected.boxes,
        projected.records,
        projected.records.view(np.uint32),
        projected.counts,
        slots,
        centres,
        visible,
        keys,
        ids,
        spare_keys,
        spare_ids,
        memory.empty((listing, DIGITS), np.int64),
        memory.empty(DIGITS + 1, np.int64),
        columns,
        memory.empty((listing, columns * rows), np.int64),
        starts,
        tile_ids,
        tile_slots,
        longest,
    )
    if listing == 1:
        share(1, run_tile_steps, 0, STEPS, *arguments)
    else:
        for step in range(STEPS):
            share(1 if step in UNSHARED else workers, run_tile_steps, step, step + 1, *arguments)
    return PairLists(slots, starts, tile_ids, tile_slots, int(longest[0]))
