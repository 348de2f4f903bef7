"""The label gradients of a batch of Gaussians: its weights on each patch times the gradients of the pixels' labels."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, part
from ...machine.vectors import get, load, put, spread, store, store_past_cache
from ..records import BATCH, PATCH_HEIGHT, PATCH_WIDTH, TILE
from .backward_tile import BATCH_LABELS, LISTED, WEIGHTS
from .chunk import PATCHES
from .forward_strip import ZERO
from .labels import copy_labels
from .products import (
    BLOCK,
    ROWS,
    unblend_1,
    unblend_2,
    unblend_3,
    unblend_four_1,
    unblend_four_2,
    unblend_four_3,
)

NOBODY = BATCH
"""Stands for a member where there is none. Its place among the labels is nobody's, and no one reads it."""


def _vector_adder(of_rows: Any, of_four: Any) -> Any:
    """A function that adds the gradients of all members in the vectors from channel ``c`` on."""

    @part
    def add(
        c: int,
        listed: int,
        count: int,
        source: Array,
        upper: int,
        lower: int,
        stride: int,
        scratch: Array,
        members: Array,
        padded: int,
    ) -> None:
        # members in a loop of this function's own: a call for a few of them takes a third as long as their products
        out, k, end = BATCH_LABELS + c, listed, listed + count
        while k + ROWS <= end:
            w = WEIGHTS + k * TILE
            of_rows(scratch, out, members, k, source, upper + c, lower + c, scratch, w, padded, stride)
            k += ROWS
        if k < end:
            w = WEIGHTS + k * TILE
            of_four(scratch, out, members, k, source, upper + c, lower + c, scratch, w, padded, stride)

    return add


add_3 = _vector_adder(unblend_3, unblend_four_3)
add_2 = _vector_adder(unblend_2, unblend_four_2)
add_1 = _vector_adder(unblend_1, unblend_four_1)


@part
def add_patch_gradients(
    patch: int,
    count: int,
    source: Array,
    upper: int,
    lower: int,
    stride: int,
    scratch: Array,
    members: Array,
    padded: int,
) -> None:
    """The batch's label gradients += the weights of a patch, of so many members, times the label gradients of its
    pixels: those of its two rows lie at source[upper:] and source[lower:], ``stride`` floats apart."""
    listed = patch * LISTED
    for missing in range(count, count + 3):
        put(members, listed + missing, np.int32(NOBODY))
        store(scratch, WEIGHTS + (listed + missing) * TILE, spread(ZERO))
    fours = (count + 3) & -4
    c = 0
    while c + 3 * BLOCK <= padded:
        add_3(c, listed, fours, source, upper, lower, stride, scratch, members, padded)
        c += 3 * BLOCK
    if c + 2 * BLOCK <= padded:
        add_2(c, listed, fours, source, upper, lower, stride, scratch, members, padded)
    elif c + BLOCK <= padded:
        add_1(c, listed, fours, source, upper, lower, stride, scratch, members, padded)


@part
def add_label_gradients(
    left: int,
    top: int,
    width: int,
    height: int,
    d_labels: Array,
    channels: int,
    scratch: Array,
    counts: Array,
    members: Array,
    padded: int,
) -> None:
    """The batch's label gradients, patch after patch. They are read where they lie, beyond a pixel's own channels too
    (no one looks at what becomes of that); only where that would leave the row or the image are they copied first."""
    for patch in range(PATCHES):
        count = get(counts, patch)
        if count == 0:
            continue
        put(counts, patch, 0)
        row, column = top + (patch & -2), left + (patch & 1) * PATCH_WIDTH
        upper = row * width + column
        lower = upper + width
        is_inside = column + PATCH_WIDTH <= width and row + PATCH_HEIGHT <= height
        if is_inside and (lower + PATCH_WIDTH) * channels + TILE <= d_labels.shape[0]:
            upper, lower = upper * channels, lower * channels
            add_patch_gradients(patch, count, d_labels, upper, lower, channels, scratch, members, padded)
        else:
            copy = BATCH_LABELS + (BATCH + 1) * padded
            for y in range(PATCH_HEIGHT):
                for x in range(PATCH_WIDTH):
                    at = copy + (y * PATCH_WIDTH + x) * padded
                    if row + y < height and column + x < width:
                        copy_labels((row + y) * width + column + x, d_labels, channels, scratch, at)
                    else:
                        for c in range(0, padded, TILE):
                            store(scratch, at + c, spread(ZERO))
            lower = copy + PATCH_WIDTH * padded
            add_patch_gradients(patch, count, scratch, copy, lower, padded, scratch, members, padded)


@part
def write_label_gradients(
    batch: int,
    count: int,
    first: int,
    tile_slots: Array,
    touched: Array,
    scratch: Array,
    slot_labels: Array,
    padded: int,
) -> None:
    """Those of a batch of so many members, of which the first has the place ``batch`` in the tile's list and the list
    begins at tile_slots[first:], go to their slots, past the cache."""
    for member in range(count):
        slot = int(get(tile_slots, first + batch + member))
        if get(touched, slot) != 0:
            source = BATCH_LABELS + member * padded
            for c in range(0, padded, TILE):
                store_past_cache(slot_labels, slot * padded + c, load(scratch, source + c))
