"""The labels of a strip.

The labels of its Gaussians are copied side by side, batch by batch. They are added up by their weights on each patch
and written past the cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ...machine.compiled import Array, device_function, inlined
from ...machine.matrix_product import Factors, ListedRows, Rows, add_product
from ...machine.vectors import (
    broadcast,
    get,
    is_aligned,
    lane_numbers,
    load,
    masked_load,
    masked_store,
    prefetch,
    store,
    store_nontemporal,
    trailing_zeros,
)
from ..records import PATCH_HEIGHT, PATCH_WIDTH, TILE, padded_channels
from .forward_strip import LISTED, WEIGHTS, F

LINES_AT_ONCE = 12
"""Cache lines that a core can have under way to memory. With more of them it waits."""
LINES_BETWEEN = LINES_AT_ONCE // 2
"""Cache lines of a finished strip that are written between steps of the next one, which has lines under way itself."""

Lines = tuple[int, int]
"""How many cache lines of a strip's upper row, and of its lower one, have yet to be written."""


class FinishedStrip(NamedTuple):
    """Places in floats: its labels lie at ``source`` in the scratch and go to ``target`` in ``labels_out``. From one of
    its rows to the other it is ``padded_row`` in the scratch and ``row`` in labels_out."""

    labels_out: Array
    source: int
    target: int
    padded_row: int
    row: int


@device_function
def copy_labels(gaussian: int, labels: Array, channels: int, scratch: Array, at: int) -> None:
    """One Gaussian's labels, padded with zeros to whole vectors."""
    source = gaussian * channels
    for c in range(0, channels - TILE + 1, TILE):
        store(scratch, at + c, load(labels, source + c))
    rest = channels % TILE
    if rest > 0:
        c = channels - rest
        store(scratch, at + c, masked_load(labels, source + c, lane_numbers() < broadcast(F(rest))))


@device_function
def prefetch_labels(first: int, count: int, flatten_ids: Array, labels: Array, channels: int) -> None:
    """Have the labels of a batch brought: they lie anywhere in memory, and will be needed soon."""
    for m in range(count):
        source = int(get(flatten_ids, first + m)) * channels
        for c in range(0, channels, TILE):
            prefetch(labels, source + c)
        prefetch(labels, source + channels - 1)


@device_function
def copy_members(
    members: int, first: int, flatten_ids: Array, labels: Array, channels: int, scratch: Array, at: int
) -> None:
    """The labels of a batch's members, of which ``members`` has the bits, to scratch[at:]. The batch begins at
    flatten_ids[first:]."""
    while members != 0:
        m = trailing_zeros(members)
        members &= members - 1
        gaussian = int(get(flatten_ids, first + m))
        copy_labels(gaussian, labels, channels, scratch, at + m * padded_channels(channels))


@inlined
def flush_some(lines: int, most: int, source: int, target: int, scratch: Array, labels_out: Array) -> Any:
    """Write at most ``most`` of the ``lines`` that begin at scratch[source], the last ones first, past the cache.
    Returns how many are left."""
    left = max(lines - most, 0)
    for line in range(left, lines):
        store_nontemporal(labels_out, target + line * TILE, load(scratch, source + line * TILE))
    return left


@device_function
def flush_lines(lines: Lines, finished: FinishedStrip, scratch: Array) -> Any:
    """Write at most ``LINES_BETWEEN`` lines of a strip, none of the upper row before all of the lower one; the lines
    that are left of each."""
    upper, lower = lines
    source, target, out = finished.source, finished.target, finished.labels_out
    if lower > 0:
        at = target + finished.row
        return upper, flush_some(lower, LINES_BETWEEN, source + finished.padded_row, at, scratch, out)
    return flush_some(upper, LINES_BETWEEN, source, target, scratch, out), lower


@inlined
def flush_all(lines: Lines, finished: FinishedStrip, scratch: Array) -> None:
    """All that is left of a strip."""
    upper, lower = lines
    source, target, out = finished.source, finished.target, finished.labels_out
    flush_some(lower, lower, source + finished.padded_row, target + finished.row, scratch, out)
    flush_some(upper, upper, source, target, scratch, out)


@device_function
def add_listed_labels(
    patch: int,
    end: int,
    strip_labels: int,
    scratch: Array,
    members: Array,
    batches: int,
    lines: Lines,
    finished: FinishedStrip,
) -> Any:
    """The labels of a patch's pixels += the weights of those blended, whose list ends before ``end``, times their
    labels. The strip's labels lie at scratch[strip_labels:], those of the listed so many vectors behind
    scratch[batches:] as ``members`` says.

    After each row, whether anything was blended or not, some ``lines`` of the strip before are written; returns the end
    of the empty list, and the lines that are left.
    """
    listed, padded = patch * LISTED, finished.padded_row // TILE
    if padded > 0:
        first_pixel = strip_labels + patch * PATCH_WIDTH * padded
        source = ListedRows(scratch, batches, TILE, members, listed)
        for row in range(PATCH_HEIGHT):
            out = Rows(scratch, first_pixel + row * finished.padded_row, padded)
            weights = Factors(scratch, WEIGHTS + listed * TILE + row, PATCH_HEIGHT, TILE)
            add_product(out, weights, source, PATCH_WIDTH, padded, end - listed)
            lines = flush_lines(lines, finished, scratch)
    return listed, lines


@device_function
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
        rest = lane_numbers() < broadcast(F(floats - at))
        masked_store(labels_out, target + at, load(scratch, row_labels + at), rest)
    return lines
