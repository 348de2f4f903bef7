"""The steps from boxes to lists of tiles, front to back; ``tile_lists`` has them done.

Visible Gaussians are sorted by depth (least significant digit first, stable, so ties keep the order of their
indices), then dealt out to their tiles in that order. This takes thirteen steps, of which each needs all of the one
before. A worker does its share of a step, a range; the result does not depend on how many workers there are.
"""

from __future__ import annotations

import numpy as np

from ..machine.compiled import Array, part
from ..machine.shared import shared
from .records import DEPTH

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
DIGIT_PASSES = 3
assert DIGIT_PASSES % 2 == 1, "each pass goes from the keys to the spare ones, or back: the last one goes there"

# steps: of each digit there are three
LIST_VISIBLE = 0
COUNT_DIGITS, START_DIGITS, DEAL_DIGITS = 1, 2, 3
COUNT_TILES = 1 + 3 * DIGIT_PASSES
START_TILES, DEAL_TILES, STEPS = COUNT_TILES + 1, COUNT_TILES + 2, COUNT_TILES + 3
UNSHARED = (*range(START_DIGITS, COUNT_TILES, 3), START_TILES)
"""The steps that are done by one worker, whatever the number of those that share the others."""


@part
def list_visible(
    worker: int,
    workers: int,
    boxes: Array,
    records: Array,
    bits: Array,
    counts: Array,
    keys: Array,
    ids: Array,
    slots: Array,
    centres: Array,
    visible: Array,
) -> None:
    """keys uint32 [V], ids int32 [V] of the visible in index order; slots int64 [N + 1], running sum of
    touched tiles.

    ``bits`` uint32 [N, RECORD] are those of the records; ``counts`` int64 [workers, 2] those of ``project``, which may
    have had more workers. Also fills ``visible`` bool [N] and
    ``centres`` [N, 2] (pixels, zero where not visible).
    """
    count = boxes.shape[0]
    place, slot = 0, 0
    for other in range(worker):
        place += counts[other, 0]
        slot += counts[other, 1]
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


@part
def count_digits(worker: int, workers: int, keys: Array, shift: np.uint32, histograms: Array) -> None:
    count = keys.shape[0]
    for digit in range(DIGITS):
        histograms[worker, digit] = 0
    for i in range(count * worker // workers, count * (worker + 1) // workers):
        histograms[worker, (keys[i] >> shift) & np.uint32(DIGITS - 1)] += 1


@part
def running_starts(histograms: Array, starts: Array) -> int:
    """Counts [workers, bins] become the places where each worker's share of each bin begins; starts [bins +
    1] the bins'. Returns the largest bin's count."""
    workers, bins = histograms.shape
    total, largest = 0, 0
    for b in range(bins):
        starts[b] = total
        for worker in range(workers):
            own = histograms[worker, b]
            histograms[worker, b] = total
            total += own
        largest = max(largest, total - starts[b])
    starts[bins] = total
    return largest


@part
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


@part
def count_tiles(worker: int, workers: int, order: Array, boxes: Array, columns: int, histograms: Array) -> None:
    count = order.shape[0]
    for tile in range(histograms.shape[1]):
        histograms[worker, tile] = 0
    for k in range(count * worker // workers, count * (worker + 1) // workers):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                histograms[worker, row * columns + column] += 1


@part
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


@shared
def run_tile_steps(
    worker: int,
    workers: int,
    first: int,
    end: int,
    boxes: Array,
    records: Array,
    bits: Array,
    counts: Array,
    slots: Array,
    centres: Array,
    visible: Array,
    keys: Array,
    ids: Array,
    spare_keys: Array,
    spare_ids: Array,
    digits: Array,
    digit_starts: Array,
    columns: int,
    histograms: Array,
    starts: Array,
    tile_ids: Array,
    tile_slots: Array,
    longest: Array,
) -> None:
    """A worker's share of the steps from ``first`` to before ``end``: of one, or of all where it works alone.

    Of N Gaussians: ``boxes`` int32 [N, 4] in tiles, ``records`` float32 [N, RECORD] and their ``bits`` as uint32;
    ``counts`` int64 [workers, 2]: visible ones, and pairs of Gaussian and tile, in the share of each.

    Filled: ``slots`` int64 [N + 1], ``centres`` float32 [N, 2], ``visible`` bool [N]; ``keys`` uint32 and ``ids`` int32
    of the V visible ones, and spare ones to sort them; ``starts`` int64 [tiles + 1], ``tile_ids`` and ``tile_slots``
    int32 [T], as in ``PairLists``; ``longest`` int64 [1], the length of the longest list. ``digits`` int64 [workers,
    DIGITS], ``digit_starts`` int64 [DIGITS + 1] and ``histograms`` int64 [workers, tiles] are room to work in.
    """
    for step in range(first, end):
        if step == LIST_VISIBLE:
            list_visible(worker, workers, boxes, records, bits, counts, keys, ids, slots, centres, visible)
        elif step < COUNT_TILES:
            digit_pass, part_of_pass = (step - COUNT_DIGITS) // 3, (step - COUNT_DIGITS) % 3 + COUNT_DIGITS
            shift = np.uint32(DIGIT_BITS * digit_pass)
            back = digit_pass % 2 == 1
            own_keys, own_ids = (spare_keys, spare_ids) if back else (keys, ids)
            if part_of_pass == COUNT_DIGITS:
                count_digits(worker, workers, own_keys, shift, digits)
            elif part_of_pass == START_DIGITS:
                running_starts(digits, digit_starts)
            elif part_of_pass == DEAL_DIGITS:
                keys_out, ids_out = (keys, ids) if back else (spare_keys, spare_ids)
                deal_digits(worker, workers, own_keys, own_ids, shift, digits, keys_out, ids_out)
        elif step == COUNT_TILES:  # the order ends in the spare ones: the number of passes is odd
            count_tiles(worker, workers, spare_ids, boxes, columns, histograms)
        elif step == START_TILES:
            longest[0] = running_starts(histograms, starts)
        elif step == DEAL_TILES:
            deal_tiles(worker, workers, spare_ids, boxes, slots, columns, histograms, tile_ids, tile_slots)
