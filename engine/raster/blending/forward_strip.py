"""A strip of a tile, two rows as two patches side by side: where a worker keeps it, and how the image gets it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined
from ...machine.vector_shuffles import deinterleave2, interleave2, interleave3
from ...machine.vectors import broadcast, lane_numbers, load, masked_store, select, store
from ..arrays import Blended
from ..records import BATCH, PATCH_HEIGHT, PENDING, TILE, padded_channels
from .batch import STRIP_FIELDS

F = np.float32
ZERO, ONE = F(0.0), F(1.0)

# a worker's scratch, in floats
STRIP = 0  # the current strip's fields of its members
WEIGHTS = STRIP + STRIP_FIELDS  # [patch, blended, pixel], with space for those that turn out not to be blended
LISTED = PENDING + BATCH + 4
STATE = WEIGHTS + 2 * LISTED * TILE  # [patch, field, pixel]
COLUMNS, TRANSMITTANCE, FINAL, LAST = 0, TILE, 2 * TILE, 3 * TILE
PLANES = 4 * TILE  # red, green, blue, depth
PATCH_STRIDE = 8 * TILE
STRIP_LABELS = STATE + 2 * PATCH_STRIDE  # [patch, pixel, padded channels]; then fields and labels of each batch


@device_function
def strip_floats(channels: int) -> int:
    return PATCH_HEIGHT * TILE * padded_channels(channels)


@device_function
def start_strip(columns: int, rows: int, channels: int, scratch: Array) -> None:
    """Begin a strip of ``columns`` and ``rows`` of the image: nothing is blended yet, and no light passes outside the
    image."""
    left, right = interleave2(lane_numbers(), lane_numbers())
    row, _ = interleave2(broadcast(ZERO), broadcast(ONE))
    in_rows = row < broadcast(F(rows))
    for state, column in ((STATE, left), (STATE + PATCH_STRIDE, right)):
        inside = (column < broadcast(F(columns))) & in_rows
        store(scratch, state + COLUMNS, column)
        store(scratch, state + TRANSMITTANCE, select(inside, broadcast(ONE), broadcast(ZERO)))
        store(scratch, state + FINAL, broadcast(ONE))
        store(scratch, state + LAST, broadcast(-ONE))
        for plane in range(4):
            store(scratch, state + PLANES + plane * TILE, broadcast(ZERO))
    for at in range(STRIP_LABELS, STRIP_LABELS + strip_floats(channels), TILE):
        store(scratch, at, broadcast(ZERO))


@inlined
def rows_of(field: int, scratch: Array) -> Any:
    """A field of the strip's two patches, as its two rows."""
    return deinterleave2(load(scratch, STATE + field), load(scratch, STATE + PATCH_STRIDE + field))


@device_function
def write_strip(pixel: int, columns: int, rows: int, width: int, scratch: Array, out: Blended) -> None:
    """Write the ``columns`` and ``rows`` of a strip without labels. Its first pixel has the number ``pixel``."""
    upper_final, lower_final = rows_of(FINAL, scratch)
    upper_last, lower_last = rows_of(LAST, scratch)
    upper_red, lower_red = rows_of(PLANES, scratch)
    upper_green, lower_green = rows_of(PLANES + TILE, scratch)
    upper_blue, lower_blue = rows_of(PLANES + 2 * TILE, scratch)
    upper_depth, lower_depth = rows_of(PLANES + 3 * TILE, scratch)
    upper = (upper_final, upper_last, upper_red, upper_green, upper_blue, upper_depth)
    lower = (lower_final, lower_last, lower_red, lower_green, lower_blue, lower_depth)
    write_row(pixel, columns, upper, out)
    if rows > 1:
        write_row(pixel + width, columns, lower, out)


@inlined
def write_row(pixel: int, columns: int, state: Any, out: Blended) -> None:
    """Write one row of a strip."""
    final, last, red, green, blue, own_depth = state
    inside = lane_numbers() < broadcast(F(columns))
    masked_store(out.final, pixel, final, inside)
    masked_store(out.alpha, pixel, broadcast(ONE) - final, inside)
    masked_store(out.depth, pixel, own_depth, inside)
    masked_store(out.last, pixel, last, inside)
    write_colours(3 * pixel, 3 * columns, interleave3(red, green, blue), out.image)


@inlined
def write_colours(target: int, floats: int, colours: Any, image: Array) -> None:
    """Write a row's colours, pixel by pixel, to image[target : target + floats]."""
    first, second, third = colours
    masked_store(image, target, first, lane_numbers() < broadcast(F(floats)))
    masked_store(image, target + TILE, second, lane_numbers() < broadcast(F(floats - TILE)))
    masked_store(image, target + 2 * TILE, third, lane_numbers() < broadcast(F(floats - 2 * TILE)))
