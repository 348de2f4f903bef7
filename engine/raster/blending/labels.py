"""The labels of a strip.

The labels of its Gaussians are copied side by side, batch by batch, and added up by their weights on each patch.
"""

from __future__ import annotations

from ...machine.compiled import Array, device_function
from ...machine.matrix_product import Factors, ListedRows, Rows, add_product
from ...machine.vectors import (
    broadcast,
    get,
    lane_numbers,
    load,
    masked_load,
    masked_store,
    prefetch,
    store,
)
from ..arrays import Size
from ..records import PATCH_HEIGHT, TILE, padded_channels
from .batch import AHEAD
from .forward_strip import LISTED, STRIP_LABELS, WEIGHTS, F


@device_function
def copy_labels(gaussian: int, labels: Array, channels: int, scratch: Array, at: int) -> None:
    """Copy one Gaussian's labels, padded with zeros to whole vectors."""
    source = gaussian * channels
    for c in range(0, channels - TILE + 1, TILE):
        store(scratch, at + c, load(labels, source + c))
    rest = channels % TILE
    if rest > 0:
        c = channels - rest
        store(scratch, at + c, masked_load(labels, source + c, lane_numbers() < broadcast(F(rest))))


@device_function
def load_labels(
    first: int, count: int, flatten_ids: Array, labels: Array, channels: int, scratch: Array, at: int
) -> None:
    """Copy the labels of a batch's members side by side to scratch[at:]. The batch begins at flatten_ids[first:]."""
    for m in range(count):
        ahead = int(get(flatten_ids, first + min(m + AHEAD, count - 1))) * channels
        for c in range(0, channels, TILE):
            prefetch(labels, ahead + c)
        copy_labels(int(get(flatten_ids, first + m)), labels, channels, scratch, at + m * padded_channels(channels))


@device_function
def add_listed_labels(patch: int, end: int, scratch: Array, members: Array, batches: int, padded: int) -> int:
    """The labels of a patch's pixels += the weights of those blended, whose list ends before ``end``, times their
    labels, whose offsets in vectors from scratch[batches:] are in ``members``. Returns the end of the empty list.
    """
    listed = patch * LISTED
    out = Rows(scratch, STRIP_LABELS + patch * TILE * padded, padded)
    weights = Factors(scratch, WEIGHTS + listed * TILE, 1, TILE)
    add_product(out, weights, ListedRows(scratch, batches, TILE, members, listed), TILE, padded, end - listed)
    return listed


@device_function
def write_labels(pixel: int, columns: int, rows: int, size: Size, scratch: Array, labels_out: Array) -> None:
    """Write the labels of a strip of ``columns`` and ``rows`` without their padding. Its first pixel has the number
    ``pixel``."""
    channels, padded = size.channels, padded_channels(size.channels)
    in_tail = lane_numbers() < broadcast(F(channels - padded + TILE))
    for y in range(rows):
        for x in range(columns):
            source = STRIP_LABELS + (PATCH_HEIGHT * x + y) * padded
            target = (pixel + y * size.width + x) * channels
            for c in range(0, padded - TILE, TILE):
                store(labels_out, target + c, load(scratch, source + c))
            masked_store(labels_out, target + padded - TILE, load(scratch, source + padded - TILE), in_tail)
