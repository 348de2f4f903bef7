"""The labels of a strip: those of its Gaussians are copied side by side, chunk by chunk, added up by their weights
on each patch, and written past the cache."""

from __future__ import annotations

from typing import Any

from ...machine.compiled import Array, inlined, part
from ...machine.vectors import (
    fetch,
    get,
    is_aligned,
    lane_numbers,
    load,
    load_some,
    lowest_bit,
    put,
    spread,
    store,
    store_past_cache,
    store_some,
)
from ..records import PATCH_HEIGHT, PATCH_WIDTH, TILE, padded_channels
from .forward_strip import F
from .products import BLOCK, ROWS, blend_1, blend_2, blend_3

LINES_AT_ONCE = 12
"""Cache lines that a core can have under way to memory: with more of them it waits."""
LINES_BETWEEN = LINES_AT_ONCE // 2
"""So many of a strip are written between steps of the next one, which has lines under way itself."""

Lines = tuple[int, int]
"""How many cache lines of a strip's upper row, and of its lower one, have yet to be written."""
FinishedStrip = tuple[int, int, int, int]
"""In floats: where its labels lie in the scratch, and where they go among labels_out; from one of its rows to the other
in the scratch, and in labels_out."""


@part
def copy_labels(gaussian: int, labels: Array, channels: int, scratch: Array, at: int) -> None:
    """One Gaussian's labels, padded with zeros to whole vectors."""
    source = gaussian * channels
    for c in range(0, channels - TILE + 1, TILE):
        store(scratch, at + c, load(labels, source + c))
    rest = channels % TILE
    if rest > 0:
        c = channels - rest
        store(scratch, at + c, load_some(labels, source + c, lane_numbers() < spread(F(rest))))


@part
def fetch_labels(first: int, count: int, tile_ids: Array, labels: Array, channels: int) -> None:
    """Have the labels of a chunk brought: they lie anywhere in memory, and will be needed soon."""
    for m in range(count):
        source = int(get(tile_ids, first + m)) * channels
        for c in range(0, channels, TILE):
            fetch(labels, source + c)
        fetch(labels, source + channels - 1)


@part
def copy_touching(
    touching: int,
    first: int,
    tile_ids: Array,
    labels: Array,
    channels: int,
    scratch: Array,
    at: int,
    copied: Array,
    c: int,
) -> None:
    """The labels of a chunk's members that no patch before has touched, to scratch[at:]."""
    fresh = touching & ~get(copied, c)
    put(copied, c, get(copied, c) | touching)
    while fresh != 0:
        m = lowest_bit(fresh)
        fresh &= fresh - 1
        gaussian = int(get(tile_ids, first + m))
        copy_labels(gaussian, labels, channels, scratch, at + m * padded_channels(channels))


@inlined
def flush_some(lines: int, most: int, source: int, target: int, scratch: Array, labels_out: Array) -> Any:
    """Write at most so many of the ``lines`` whose first is scratch[source], the last ones first, past the cache.
    Returns how many are left."""
    left = max(lines - most, 0)
    for line in range(left, lines):
        store_past_cache(labels_out, target + line * TILE, load(scratch, source + line * TILE))
    return left


@part
def flush_lines(lines: Lines, finished: FinishedStrip, scratch: Array, labels_out: Array) -> Any:
    """Write at most ``LINES_BETWEEN`` lines of a strip, none of the upper row before all of the lower one; the lines
    that are left of each."""
    upper, lower = lines
    source, target, padded_row, row = finished
    if lower > 0:
        return upper, flush_some(lower, LINES_BETWEEN, source + padded_row, target + row, scratch, labels_out)
    return flush_some(upper, LINES_BETWEEN, source, target, scratch, labels_out), lower


@inlined
def flush_all(lines: Lines, finished: FinishedStrip, scratch: Array, labels_out: Array) -> None:
    """All that is left of a strip."""
    upper, lower = lines
    source, target, padded_row, row = finished
    flush_some(lower, lower, source + padded_row, target + row, scratch, labels_out)
    flush_some(upper, upper, source, target, scratch, labels_out)


@part
def add_patch_labels(
    count: int,
    patch_labels: int,
    scratch: Array,
    weights: int,
    members: Array,
    listed: int,
    labels: int,
    padded: int,
    lines: Lines,
    finished: FinishedStrip,
    labels_out: Array,
) -> Any:
    """The labels of a patch's pixels, the first of which lie at scratch[patch_labels:], += the weights of those blended
    times their labels, a few pixels of a row times three vectors at a time. members[listed:] are so many vectors behind
    scratch[labels:]. After each row, whether anything was blended or not, some ``lines`` of the strip before are
    written; returns those that are left."""
    for row in range(PATCH_HEIGHT):
        for x in range(0, PATCH_WIDTH, ROWS):
            out = patch_labels + (row * TILE + x) * padded
            w = weights + PATCH_HEIGHT * x + row
            c = 0
            while c + 3 * BLOCK <= padded:
                blend_3(scratch, out + c, scratch, labels + c, members, listed, scratch, w, count, padded)
                c += 3 * BLOCK
            if c + 2 * BLOCK <= padded:
                blend_2(scratch, out + c, scratch, labels + c, members, listed, scratch, w, count, padded)
            elif c + BLOCK <= padded:
                blend_1(scratch, out + c, scratch, labels + c, members, listed, scratch, w, count, padded)
        lines = flush_lines(lines, finished, scratch, labels_out)
    return lines


@part
def pack_labels(target: int, pixels: int, channels: int, row_labels: int, scratch: Array, labels_out: Array) -> Any:
    """Take the padding out of a row's labels, which belong to labels_out[target:], and write those that fill no cache
    line. Returns how many lines are left for ``flush_lines``."""
    padded = padded_channels(channels)
    for x in range(1, pixels):
        for c in range(0, padded, TILE):  # what is too much, the next pixel writes over
            store(scratch, row_labels + x * channels + c, load(scratch, row_labels + x * padded + c))
    floats = pixels * channels
    lines = floats // TILE if is_aligned(labels_out, target) else 0
    for at in range(lines * TILE, floats, TILE):
        rest = lane_numbers() < spread(F(floats - at))
        store_some(labels_out, target + at, load(scratch, row_labels + at), rest)
    return lines
