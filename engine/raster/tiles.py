"""Which Gaussians each tile draws, front to back.

Visible Gaussians are sorted by depth (least significant digit first, stable, so ties keep the order of their
indices), then dealt out to their tiles in that order. Every kernel here does one worker's share, a range; the
result does not depend on how many workers there are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import memory
from .compiled import Array, compiled
from .crew import share
from .records import DEPTH, TILE

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
DIGIT_PASSES = 3
WORTH_SHARING = 2_500
"""Fewer Gaussians than this are sorted by one worker: waking the others takes longer."""


@compiled
def list_visible(
    worker: int,
    workers: int,
    boxes: Array,
    records: Array,
    bits: Array,
    places: Array,
    slot_starts: Array,
    keys: Array,
    ids: Array,
    slots: Array,
    centres: Array,
    visible: Array,
) -> None:
    """keys uint32 [V], ids int32 [V] of the visible in index order; slots int64 [N + 1], running sum of
    touched tiles.

    ``bits`` uint32 [N, RECORD] are those of the records. Also fills ``visible`` bool [N] and
    ``centres`` [N, 2] (pixels, zero where not visible).
    """
    count = boxes.shape[0]
    place = places[worker]
    slot = slot_starts[worker]
    for i in range(count * worker // workers, count * (worker + 1) // workers):
        slots[i] = slot
        tiles = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        visible[i] = tiles > 0
        centres[i, 0] = np.float32(0.0)
        centres[i, 1] = np.float32(0.0)
        if tiles > 0:
            centres[i, 0] = records[i, 0]
            centres[i, 1] = records[i, 2]
            # depths are positive: their bits sort as they do
            keys[place] = bits[i, DEPTH]
            ids[place] = i
            place += 1
            slot += tiles
    if worker == workers - 1:
        slots[count] = slot


@compiled
def count_digits(worker: int, workers: int, keys: Array, shift: np.uint32, histograms: Array) -> None:
    count = keys.shape[0]
    for digit in range(DIGITS):
        histograms[worker, digit] = 0
    for i in range(count * worker // workers, count * (worker + 1) // workers):
        histograms[worker, (keys[i] >> shift) & np.uint32(DIGITS - 1)] += 1


@compiled
def running_starts(histograms: Array, starts: Array) -> None:
    """Counts [workers, bins] become the places where each worker's share of each bin begins; starts [bins +
    1] the bins'."""
    workers, bins = histograms.shape
    total = 0
    for b in range(bins):
        starts[b] = total
        for worker in range(workers):
            own = histograms[worker, b]
            histograms[worker, b] = total
            total += own
    starts[bins] = total


@compiled
def deal_digits(
    worker: int,
    workers: int,
    keys: Array,
    ids: Array,
    shift: np.uint32,
    places: Array,
    keys_out: Array,
    ids_out: Array,
) -> None:
    count = keys.shape[0]
    for i in range(count * worker // workers, count * (worker + 1) // workers):
        digit = (keys[i] >> shift) & np.uint32(DIGITS - 1)
        place = places[worker, digit]
        places[worker, digit] = place + 1
        keys_out[place] = keys[i]
        ids_out[place] = ids[i]


@compiled
def count_tiles(
    worker: int, workers: int, order: Array, boxes: Array, columns: int, histograms: Array
) -> None:
    count = order.shape[0]
    for tile in range(histograms.shape[1]):
        histograms[worker, tile] = 0
    for k in range(count * worker // workers, count * (worker + 1) // workers):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                histograms[worker, row * columns + column] += 1


@compiled
def deal_tiles(
    worker: int,
    workers: int,
    order: Array,
    boxes: Array,
    slots: Array,
    columns: int,
    places: Array,
    tile_ids: Array,
    tile_slots: Array,
) -> None:
    """tile_ids int32 [T] (Gaussian) and tile_slots int32 [T] (where its gradient in that tile goes), tile
    after tile."""
    count = order.shape[0]
    for k in range(count * worker // workers, count * (worker + 1) // workers):
        i = order[k]
        slot = slots[i]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * columns + column
                place = places[worker, tile]
                places[worker, tile] = place + 1
                tile_ids[place] = i
                tile_slots[place] = slot
                slot += 1


def sort_by_depth(workers: int, keys: Array, ids: Array) -> Any:
    """The visible Gaussians int32 [V], front to back."""
    spare_keys, spare_ids = memory.empty(keys.size, np.uint32), memory.empty(keys.size, np.int32)
    histograms = memory.empty((workers, DIGITS), np.int64)
    starts = memory.empty(DIGITS + 1, np.int64)
    for digit_pass in range(DIGIT_PASSES):
        shift = np.uint32(DIGIT_BITS * digit_pass)
        share(workers, count_digits, keys, shift, histograms)
        running_starts(histograms, starts)
        share(workers, deal_digits, keys, ids, shift, histograms, spare_keys, spare_ids)
        keys, spare_keys = spare_keys, keys
        ids, spare_ids = spare_ids, ids
    return ids


def deal(
    workers: int, order: Array, boxes: Array, slots: Array, touched: int, width: int, height: int
) -> Any:
    """starts int64 [tiles + 1], tile_ids int32 [T], tile_slots int32 [T]: each tile's Gaussians, front to
    back."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    tile_ids, tile_slots = memory.empty(touched, np.int32), memory.empty(touched, np.int32)
    histograms = memory.empty((workers, columns * rows), np.int64)
    starts = memory.empty(columns * rows + 1, np.int64)
    share(workers, count_tiles, order, boxes, columns, histograms)
    running_starts(histograms, starts)
    share(workers, deal_tiles, order, boxes, slots, columns, histograms, tile_ids, tile_slots)
    return starts, tile_ids, tile_slots
