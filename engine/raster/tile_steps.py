"""From boxes to lists of tiles, front to back, in steps of which each needs all of the one before.

Visible Gaussians are sorted by depth (least significant digit first, stable, so ties keep the order of their
indices), then dealt out to their tiles in that order. A step is done in portions, ranges of Gaussians; the result does
not depend on how many there are, nor on who does them: a worker that is late finds them done.
"""

from __future__ import annotations

import numpy as np

from ..machine.atomics import raise_by_one, read_counter
from ..machine.compiled import Array, parallel_kernel, part
from .portions import range_of

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
DIGIT_PASSES = 3
assert DIGIT_PASSES % 2 == 1, "each pass goes from the keys to the spare ones, or back: the last one goes there"

# steps: of each digit there are three
LIST_VISIBLE = 0
COUNT_DIGITS, START_DIGITS, DEAL_DIGITS = 1, 2, 3
COUNT_TILES = 1 + 3 * DIGIT_PASSES
START_TILES, DEAL_TILES, STEPS = COUNT_TILES + 1, COUNT_TILES + 2, COUNT_TILES + 3
LINE = 8
"""Words of a cache line: counters have one each."""
PROGRESS = 2 * STEPS * LINE
"""Words: of each step, how many portions were taken and how many are done."""
LOOKS = 1_000_000
"""How often a helper looks whether a step is done, about half a millisecond, before it leaves the rest to the caller,
who stays: more workers than processors would keep each other from running."""


@part
def list_visible(
    portion: int,
    boxes: Array,
    depths: Array,
    counts: Array,
    keys: Array,
    ids: Array,
    slots: Array,
) -> None:
    """keys uint32 and ids int32 of the visible in index order; slots int64 [N + 1], running sum of touched tiles.

    ``depths`` uint32 [N] are those of the visible, bit by bit; ``counts`` int64 [portions, 2] those of ``project``.
    """
    count, portions = boxes.shape[0], counts.shape[0]
    first, end = range_of(portion, portions, count)
    place, slot = 0, 0
    for other in range(portion):
        place += counts[other, 0]
        slot += counts[other, 1]
    for i in range(first, end):
        slots[i] = slot
        tiles = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        if tiles > 0:
            # depths are positive: their bits sort as they do
            keys[place] = depths[i]
            ids[place] = i
            place += 1
            slot += tiles
    if portion == portions - 1:
        slots[count] = slot


@part
def count_digits(portion: int, portions: int, keys: Array, shift: np.uint32, histograms: Array) -> None:
    for digit in range(DIGITS):
        histograms[portion, digit] = 0
    first, end = range_of(portion, portions, keys.shape[0])
    for i in range(first, end):
        histograms[portion, (keys[i] >> shift) & np.uint32(DIGITS - 1)] += 1


@part
def running_starts(histograms: Array, starts: Array) -> int:
    """Counts [portions, bins] become the places where each portion's share of each bin begins; starts [bins +
    1] the bins'. Returns the largest bin's count."""
    portions, bins = histograms.shape
    total, largest = 0, 0
    for b in range(bins):
        starts[b] = total
        for portion in range(portions):
            own = histograms[portion, b]
            histograms[portion, b] = total
            total += own
        largest = max(largest, total - starts[b])
    starts[bins] = total
    return largest


@part
def deal_digits(
    portion: int,
    portions: int,
    keys: Array,
    ids: Array,
    shift: np.uint32,
    places: Array,
    keys_out: Array,
    ids_out: Array,
) -> None:
    first, end = range_of(portion, portions, keys.shape[0])
    for i in range(first, end):
        digit = (keys[i] >> shift) & np.uint32(DIGITS - 1)
        place = places[portion, digit]
        places[portion, digit] = place + 1
        keys_out[place] = keys[i]
        ids_out[place] = ids[i]


@part
def count_tiles(portion: int, portions: int, order: Array, boxes: Array, columns: int, histograms: Array) -> None:
    for tile in range(histograms.shape[1]):
        histograms[portion, tile] = 0
    first, end = range_of(portion, portions, order.shape[0])
    for k in range(first, end):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                histograms[portion, row * columns + column] += 1


@part
def deal_tiles(
    portion: int,
    portions: int,
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
    first, end = range_of(portion, portions, order.shape[0])
    for k in range(first, end):
        i = order[k]
        slot = slots[i]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * columns + column
                place = places[portion, tile]
                places[portion, tile] = place + 1
                tile_ids[place] = i
                tile_slots[place] = slot
                slot += 1


@part
def part_of_digit(step: int) -> int:
    """Which of the three steps of a digit one of them is."""
    return (step - COUNT_DIGITS) % 3 + COUNT_DIGITS


@part
def portions_of(step: int, listing: int, sorting: int, dealing: int) -> int:
    """How many portions a step has: as many as the visible are listed, digits are sorted or tiles are dealt in. Running
    starts of bins are found in one."""
    if step == LIST_VISIBLE:
        return listing
    if step < COUNT_TILES:
        return 1 if part_of_digit(step) == START_DIGITS else sorting
    return 1 if step == START_TILES else dealing


@part
def wait_for(step: int, portions: int, progress: Array, looks: int) -> bool:
    """Until all portions of a step are done, or for so many looks (for ever with 0); whether they are."""
    looked = 0
    while read_counter(progress, (2 * step + 1) * LINE) < portions:
        looked += 1
        if looked == looks:
            return False
    return True


@part
def sort_digit(
    step: int,
    portion: int,
    portions: int,
    keys: Array,
    ids: Array,
    spare_keys: Array,
    spare_ids: Array,
    digits: Array,
    digit_starts: Array,
) -> None:
    """A portion of one of the three steps of a digit."""
    digit_pass, part_of_pass = (step - COUNT_DIGITS) // 3, part_of_digit(step)
    shift = np.uint32(DIGIT_BITS * digit_pass)
    back = digit_pass % 2 == 1
    own_keys, own_ids = (spare_keys, spare_ids) if back else (keys, ids)
    if part_of_pass == COUNT_DIGITS:
        count_digits(portion, portions, own_keys, shift, digits)
    elif part_of_pass == START_DIGITS:
        running_starts(digits, digit_starts)
    elif part_of_pass == DEAL_DIGITS:
        keys_out, ids_out = (keys, ids) if back else (spare_keys, spare_ids)
        deal_digits(portion, portions, own_keys, own_ids, shift, digits, keys_out, ids_out)


@parallel_kernel
def run_tile_steps(
    worker: int,
    workers: int,
    progress: Array,
    looks: int,
    boxes: Array,
    depths: Array,
    counts: Array,
    slots: Array,
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
    """A worker's share of all steps: whatever portions it finds that nobody has taken.

    Of N Gaussians: ``boxes`` int32 [N, 4] in tiles, and ``depths`` uint32 [N] of the visible, bit by bit; ``counts``
    int64 [portions, 2]: visible ones, and pairs of Gaussian and tile, in each portion of them. ``progress`` int64
    [PROGRESS] begins with zeros; ``looks`` as ``LOOKS``.

    Filled: ``slots`` int64 [N + 1]; ``keys`` uint32 and ``ids`` int32 of the V visible ones, and spare ones to sort
    them; ``starts`` int64 [tiles + 1], ``tile_ids`` and ``tile_slots`` int32 [T], as in ``PairLists``; ``longest``
    int64 [1], the length of the longest list. Room to work in, which also tells in how many portions: ``digits`` int64
    [portions, DIGITS], ``digit_starts`` int64 [DIGITS + 1], ``histograms`` int64 [portions, tiles].
    """
    for step in range(STEPS):
        portions = portions_of(step, counts.shape[0], digits.shape[0], histograms.shape[0])
        while True:
            portion = raise_by_one(progress, 2 * step * LINE)
            if portion >= portions:
                break
            if step == LIST_VISIBLE:
                list_visible(portion, boxes, depths, counts, keys, ids, slots)
            elif step < COUNT_TILES:
                sort_digit(step, portion, portions, keys, ids, spare_keys, spare_ids, digits, digit_starts)
            elif step == COUNT_TILES:  # the order ends in the spare ones: the number of passes is odd
                count_tiles(portion, portions, spare_ids, boxes, columns, histograms)
            elif step == START_TILES:
                longest[0] = running_starts(histograms, starts)
            elif step == DEAL_TILES:
                deal_tiles(portion, portions, spare_ids, boxes, slots, columns, histograms, tile_ids, tile_slots)
            raise_by_one(progress, (2 * step + 1) * LINE)
        if not wait_for(step, portions, progress, looks if worker > 0 else 0):
            break
