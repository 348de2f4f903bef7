"""The label gradients of a batch of Gaussians: its weights on each patch times the gradients of the pixels' labels."""

from __future__ import annotations

import numpy as np

from ...machine.compiled import Array, device_function
from ...machine.matrix_product import Factors, ListedRows, Rows, add_product
from ...machine.vectors import broadcast, get, load, put, store, store_nontemporal
from ..arrays import IsectGradients, Size, Tile
from ..records import BACKWARD_BATCH, PATCH_WIDTH, TILE, padded_channels
from .backward_tile import BATCH_LABELS, LISTED, WEIGHTS, PatchLists
from .batch import PATCHES
from .forward_strip import ZERO
from .labels import copy_labels

PAD_INDEX = BACKWARD_BATCH
"""The placeholder where there is no member. Nothing reads its place among the labels."""


@device_function
def add_label_gradients(tile: Tile, size: Size, d_labels: Array, scratch: Array, lists: PatchLists) -> None:
    """The batch's label gradients += the weights of each patch times the label gradients of its pixels, which are
    copied side by side, zeros outside the image."""
    channels, padded = size.channels, padded_channels(size.channels)
    copy = BATCH_LABELS + (BACKWARD_BATCH + 1) * padded
    for patch in range(PATCHES):
        count, listed = get(lists.counts, patch), patch * LISTED
        if count == 0:
            continue
        top, left = tile.top + (patch & -2), tile.left + (patch & 1) * PATCH_WIDTH
        for pixel in range(TILE):
            row, column, at = top + (pixel & 1), left + (pixel >> 1), copy + pixel * padded
            if row < size.height and column < size.width:
                copy_labels(row * size.width + column, d_labels, channels, scratch, at)
            else:
                for c in range(0, padded, TILE):
                    store(scratch, at + c, broadcast(ZERO))
        for missing in range(count, count + 3):
            put(lists.members, listed + missing, np.int32(PAD_INDEX))
            store(scratch, WEIGHTS + (listed + missing) * TILE, broadcast(ZERO))
        out = ListedRows(scratch, BATCH_LABELS, padded, lists.members, listed)
        weights = Factors(scratch, WEIGHTS + listed * TILE, TILE, 1)
        add_product(out, weights, Rows(scratch, copy, padded), (count + 3) & -4, padded, TILE)
        put(lists.counts, patch, 0)


@device_function
def write_label_gradients(
    first: int, count: int, isect_ids: Array, scratch: Array, out: IsectGradients, padded: int
) -> None:
    """Write the label gradients of a batch to their intersections, bypassing the cache. The batch has ``count``
    members, the first of which is isect_ids[first]."""
    for member in range(count):
        isect = int(get(isect_ids, first + member))
        if get(out.touched, isect) != 0:
            source = BATCH_LABELS + member * padded
            for c in range(0, padded, TILE):
                store_nontemporal(out.labels, isect * padded + c, load(scratch, source + c))
