"""The label gradients of a batch of Gaussians: its weights on each patch times the gradients of the pixels' labels."""

from __future__ import annotations

import numpy as np

from ...machine.compiled import Array, device_function
from ...machine.matrix_product import AlternatingRows, Factors, ListedRows, add_product
from ...machine.vectors import broadcast, get, load, put, store, store_nontemporal
from ..arrays import IsectGradients, Size, Tile
from ..records import BACKWARD_BATCH, PATCH_HEIGHT, PATCH_WIDTH, TILE, padded_channels
from .backward_tile import BATCH_LABELS, LISTED, WEIGHTS, PatchLists
from .batch import PATCHES
from .forward_strip import ZERO
from .labels import copy_labels

PAD_INDEX = BACKWARD_BATCH
"""The member that stands in where there is none. Nothing reads its place among the labels."""


@device_function
def add_patch_gradients(patch: int, source: AlternatingRows, scratch: Array, lists: PatchLists, padded: int) -> None:
    """The batch's label gradients += the weights of a patch times the label gradients of its pixels, which are the rows
    of ``source``."""
    count, listed = get(lists.counts, patch), patch * LISTED
    for missing in range(count, count + 3):
        put(lists.members, listed + missing, np.int32(PAD_INDEX))
        store(scratch, WEIGHTS + (listed + missing) * TILE, broadcast(ZERO))
    out = ListedRows(scratch, BATCH_LABELS, padded, lists.members, listed)
    weights = Factors(scratch, WEIGHTS + listed * TILE, TILE, 1)
    add_product(out, weights, source, (count + 3) & -4, padded, TILE)


@device_function
def add_label_gradients(tile: Tile, size: Size, d_labels: Array, scratch: Array, lists: PatchLists) -> None:
    """The batch's label gradients, patch after patch. They are read where they lie, beyond a pixel's own channels too
    (nothing uses what becomes of those). Where that would leave the row or the image they are copied first."""
    width, height, channels = size.width, size.height, size.channels
    padded = padded_channels(channels)
    for patch in range(PATCHES):
        if get(lists.counts, patch) == 0:
            continue
        row, column = tile.top + (patch & -2), tile.left + (patch & 1) * PATCH_WIDTH
        upper = row * width + column
        lower = upper + width
        is_inside = column + PATCH_WIDTH <= width and row + PATCH_HEIGHT <= height
        if is_inside and (lower + PATCH_WIDTH) * channels + TILE <= d_labels.shape[0]:
            source = AlternatingRows(d_labels, upper * channels, lower * channels, channels)
        else:
            copy = BATCH_LABELS + (BACKWARD_BATCH + 1) * padded
            for y in range(PATCH_HEIGHT):
                for x in range(PATCH_WIDTH):
                    at = copy + (y * PATCH_WIDTH + x) * padded
                    if row + y < height and column + x < width:
                        copy_labels((row + y) * width + column + x, d_labels, channels, scratch, at)
                    else:
                        for c in range(0, padded, TILE):
                            store(scratch, at + c, broadcast(ZERO))
            source = AlternatingRows(scratch, copy, copy + PATCH_WIDTH * padded, padded)
        add_patch_gradients(patch, source, scratch, lists, padded)
        put(lists.counts, patch, 0)


@device_function
def write_label_gradients(
    first: int, count: int, isect_ids: Array, scratch: Array, out: IsectGradients, padded: int
) -> None:
    """Write the label gradients of a batch to their intersections, past the cache. The batch has ``count`` members, the
    first of which is isect_ids[first]."""
    for member in range(count):
        isect = int(get(isect_ids, first + member))
        if get(out.touched, isect) != 0:
            source = BATCH_LABELS + member * padded
            for c in range(0, padded, TILE):
                store_nontemporal(out.labels, isect * padded + c, load(scratch, source + c))
