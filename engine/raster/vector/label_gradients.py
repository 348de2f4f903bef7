"""The label gradients of a chunk of Gaussians: its weights on each patch times the gradients of the pixels' labels."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, part
from ...machine.vectors import get, load, put, spread, store, store_past_cache
from ..records import CHUNK, PATCH_HEIGHT, PATCH_WIDTH, TILE
from .backward_tile import CHUNK_LABELS, WEIGHTS
from .chunk import NOBODY, PATCHES
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


def _row_adder(unblend_3: Any, unblend_2: Any, unblend_1: Any) -> Any:
    """A function that adds the gradients of some members, those from ``listed`` on, three vectors at a time."""

    @part
    def add(
        listed: int, source: Array, upper: int, lower: int, stride: int, scratch: Array, members: Array, padded: int
    ) -> None:
        out, w, c = CHUNK_LABELS, WEIGHTS + listed * TILE, 0
        while c + 3 * BLOCK <= padded:
            unblend_3(scratch, out + c, members, listed, source, upper + c, lower + c, scratch, w, padded, stride)
            c += 3 * BLOCK
        if c + 2 * BLOCK <= padded:
            unblend_2(scratch, out + c, members, listed, source, upper + c, lower + c, scratch, w, padded, stride)
        elif c + BLOCK <= padded:
            unblend_1(scratch, out + c, members, listed, source, upper + c, lower + c, scratch, w, padded, stride)

    return add


add_rows = _row_adder(unblend_3, unblend_2, unblend_1)
add_last_four = _row_adder(unblend_four_3, unblend_four_2, unblend_four_1)


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
    """The chunk's label gradients += the weights of a patch, of so many members, times the label gradients of its
    pixels: those of its two rows lie at source[upper:] and source[lower:], ``stride`` floats apart."""
    listed = patch * CHUNK
    while count % 4 != 0:
        put(members, listed + count, np.int32(NOBODY))
        store(scratch, WEIGHTS + (listed + count) * TILE, spread(ZERO))
        count += 1
    k = 0
    while k + ROWS <= count:
        add_rows(listed + k, source, upper, lower, stride, scratch, members, padded)
        k += ROWS
    if k < count:
        add_last_four(listed + k, source, upper, lower, stride, scratch, members, padded)


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
    """The chunk's label gradients, patch after patch. They are read where they lie, beyond a pixel's own channels too
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
            copy = CHUNK_LABELS + (CHUNK + 1) * padded
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
    chunk: int,
    count: int,
    first: int,
    tile_slots: Array,
    touched: Array,
    scratch: Array,
    slot_labels: Array,
    padded: int,
) -> None:
    """Those of a chunk of so many members, of which the first has the place ``chunk`` in the tile's list and the list
    begins at tile_slots[first:], go to their slots, past the cache."""
    for member in range(count):
        slot = int(get(tile_slots, first + chunk + member))
        if get(touched, slot) != 0:
            source = CHUNK_LABELS + member * padded
            for c in range(0, padded, TILE):
                store_past_cache(slot_labels, slot * padded + c, load(scratch, source + c))
