"""From boxes to lists of tiles, front to back, in steps of which each needs all of the one before.

Visible Gaussians are sorted by depth (radix sort, least significant digit first, stable: ties keep the order of their
indices), then scattered to their tiles in that order. A step is done in chunks, ranges of Gaussians. The result does
not depend on how many there are, nor on who does them: a worker that is late finds them done.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...machine.atomics import fetch_add_at, load_acquire
from ...machine.compiled import Array, device_function, parallel_kernel
from ..arrays import Intersections
from ..chunks import chunk_range

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
DIGIT_PASSES = 3
assert DIGIT_PASSES % 2 == 1, "each pass goes from the keys to the spare ones, or back: the last one goes there"

# steps: of each digit there are three
LIST_VISIBLE = 0
COUNT_DIGITS, START_DIGITS, SCATTER_DIGITS = 1, 2, 3
COUNT_TILES = 1 + 3 * DIGIT_PASSES
START_TILES, SCATTER_TILES, STEPS = COUNT_TILES + 1, COUNT_TILES + 2, COUNT_TILES + 3
LINE = 8
"""Words of a cache line: counters have one each."""
PROGRESS = 2 * STEPS * LINE
"""Words: of each step, how many chunks were taken and how many are done."""
SPINS = 1_000_000
"""How often a helper asks whether a step is done, about half a millisecond, before it leaves the rest to the caller,
who stays: more workers than processors would keep each other from running."""


class Visible(NamedTuple):
    """Of N Gaussians: ``boxes`` int32 [N, 4] in tiles, and the bits of the ``depths`` of the visible, uint32 [N];
    ``counts`` int64 [chunks, 2], in each chunk: visible ones, and tiles that they touch."""

    boxes: Array
    depths: Array
    counts: Array


class Sorting(NamedTuple):
    """Room to sort V visible Gaussians: ``keys`` uint32 and ``ids`` int32 [V], and spare ones; ``digits`` int64
    [chunks, DIGITS] and ``digit_starts`` int64 [DIGITS + 1]; ``tiles`` int64 [chunks, tiles], counts of tiles. The
    first lengths of ``digits`` and of ``tiles`` tell in how many chunks they are counted."""

    keys: Array
    ids: Array
    spare_keys: Array
    spare_ids: Array
    digits: Array
    digit_starts: Array
    tiles: Array


@device_function
def list_visible(chunk: int, visible: Visible, sorting: Sorting, gaussian_offsets: Array) -> None:
    """Keys and ids of the visible in index order; gaussian_offsets int64 [N + 1], running sum of touched tiles."""
    boxes, counts = visible.boxes, visible.counts
    count, chunks = boxes.shape[0], counts.shape[0]
    first, end = chunk_range(chunk, chunks, count)
    place, isect = 0, 0
    for other in range(chunk):
        place += counts[other, 0]
        isect += counts[other, 1]
    for i in range(first, end):
        gaussian_offsets[i] = isect
        tiles = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        if tiles > 0:
            # depths are positive: their bits sort as they do
            sorting.keys[place] = visible.depths[i]
            sorting.ids[place] = i
            place += 1
            isect += tiles
    if chunk == chunks - 1:
        gaussian_offsets[count] = isect


@device_function
def count_digits(chunk: int, chunks: int, keys: Array, shift: np.uint32, histograms: Array) -> None:
    for digit in range(DIGITS):
        histograms[chunk, digit] = 0
    first, end = chunk_range(chunk, chunks, keys.shape[0])
    for i in range(first, end):
        histograms[chunk, (keys[i] >> shift) & np.uint32(DIGITS - 1)] += 1


@device_function
def running_starts(histograms: Array, starts: Array) -> int:
    """Counts [chunks, bins] become the places where each chunk begins in each bin; starts [bins + 1] the bins'.
    Returns the largest bin's count."""
    chunks, bins = histograms.shape
    total, largest = 0, 0
    for b in range(bins):
        starts[b] = total
        for chunk in range(chunks):
            own = histograms[chunk, b]
            histograms[chunk, b] = total
            total += own
        largest = max(largest, total - starts[b])
    starts[bins] = total
    return largest


@device_function
def scatter_digits(
    chunk: int, keys: Array, ids: Array, shift: np.uint32, places: Array, keys_out: Array, ids_out: Array
) -> None:
    first, end = chunk_range(chunk, places.shape[0], keys.shape[0])
    for i in range(first, end):
        digit = (keys[i] >> shift) & np.uint32(DIGITS - 1)
        place = places[chunk, digit]
        places[chunk, digit] = place + 1
        keys_out[place] = keys[i]
        ids_out[place] = ids[i]


@device_function
def sort_digit(step: int, chunk: int, chunks: int, sorting: Sorting) -> None:
    """A chunk of one of the three steps of a digit."""
    digit_pass, step_of_digit = (step - COUNT_DIGITS) // 3, (step - COUNT_DIGITS) % 3 + COUNT_DIGITS
    shift, digits = np.uint32(DIGIT_BITS * digit_pass), sorting.digits
    back = digit_pass % 2 == 1
    keys, ids = (sorting.spare_keys, sorting.spare_ids) if back else (sorting.keys, sorting.ids)
    if step_of_digit == COUNT_DIGITS:
        count_digits(chunk, chunks, keys, shift, digits)
    elif step_of_digit == START_DIGITS:
        running_starts(digits, sorting.digit_starts)
    else:
        keys_out, ids_out = (sorting.keys, sorting.ids) if back else (sorting.spare_keys, sorting.spare_ids)
        scatter_digits(chunk, keys, ids, shift, digits, keys_out, ids_out)


@device_function
def count_tiles(chunk: int, order: Array, boxes: Array, columns: int, histograms: Array) -> None:
    for tile in range(histograms.shape[1]):
        histograms[chunk, tile] = 0
    first, end = chunk_range(chunk, histograms.shape[0], order.shape[0])
    for k in range(first, end):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                histograms[chunk, row * columns + column] += 1


@device_function
def scatter_tiles(chunk: int, order: Array, boxes: Array, columns: int, places: Array, out: Intersections) -> None:
    """Fill flatten_ids and isect_ids, tile after tile."""
    first, end = chunk_range(chunk, places.shape[0], order.shape[0])
    for k in range(first, end):
        i = order[k]
        isect = out.gaussian_offsets[i]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * columns + column
                place = places[chunk, tile]
                places[chunk, tile] = place + 1
                out.flatten_ids[place] = i
                out.isect_ids[place] = isect
                isect += 1


@device_function
def chunks_of(step: int, visible: Visible, sorting: Sorting) -> int:
    """How many chunks a step has. Running starts of bins are found in one."""
    if step == LIST_VISIBLE:
        return visible.counts.shape[0]
    if step < COUNT_TILES:
        return 1 if (step - COUNT_DIGITS) % 3 + COUNT_DIGITS == START_DIGITS else sorting.digits.shape[0]
    return 1 if step == START_TILES else sorting.tiles.shape[0]


@device_function
def wait_for(step: int, chunks: int, progress: Array, spins: int) -> bool:
    """Until all chunks of a step are done, or for so many spins (for ever with 0); whether they are."""
    spun = 0
    while load_acquire(progress, (2 * step + 1) * LINE) < chunks:
        spun += 1
        if spun == spins:
            return False
    return True


@parallel_kernel
def bin_gaussians(
    worker: int,
    workers: int,
    progress: Array,
    spins: int,
    visible: Visible,
    columns: int,
    sorting: Sorting,
    out: tuple[Intersections, Array],
) -> None:
    """All steps: a worker does whatever chunks no other has taken.

    ``progress`` int64 [PROGRESS] begins with zeros; ``spins`` as ``SPINS``; ``columns`` of tiles. ``out`` gets the
    intersections, and in int64 [1] the length of the longest tile's list.
    """
    isects, longest = out
    for step in range(STEPS):
        chunks = chunks_of(step, visible, sorting)
        while True:
            chunk = fetch_add_at(progress, 2 * step * LINE)
            if chunk >= chunks:
                break
            if step == LIST_VISIBLE:
                list_visible(chunk, visible, sorting, isects.gaussian_offsets)
            elif step < COUNT_TILES:
                sort_digit(step, chunk, chunks, sorting)
            elif step == COUNT_TILES:  # the order ends in the spare ones: the number of passes is odd
                count_tiles(chunk, sorting.spare_ids, visible.boxes, columns, sorting.tiles)
            elif step == START_TILES:
                longest[0] = running_starts(sorting.tiles, isects.isect_offsets)
            elif step == SCATTER_TILES:
                scatter_tiles(chunk, sorting.spare_ids, visible.boxes, columns, sorting.tiles, isects)
            fetch_add_at(progress, (2 * step + 1) * LINE)
        if not wait_for(step, chunks, progress, spins if worker > 0 else 0):
            break
