"""A strip of a tile, two rows side by side as two patches: where a worker keeps it, and how it comes into the image."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, inlined, part
from ...machine.vector_shuffles import interleaved, unzipped, zipped
from ...machine.vectors import choose, fetch_to_write, lane_numbers, load, spread, store, store_some
from ..records import CHUNK, PATCH_HEIGHT, PENDING, TILE, padded_channels
from .chunk import STRIP_FIELDS

FlatLayers = tuple[Array, Array, Array, Array, Array]
"""Image [H * W * 3], alpha, depth, transmittance at the end, and place of the last Gaussian blended [H * W]."""

F = np.float32
ZERO, ONE = F(0.0), F(1.0)

# a worker's scratch, in floats
STRIP = 0  # of the strip at hand: what its members are there
WEIGHTS = STRIP + STRIP_FIELDS  # [patch, blended, pixel], with room for those that turn out not to be blended
LISTED = PENDING + CHUNK + 4
STATE = WEIGHTS + 2 * LISTED * TILE  # [patch, field, pixel]
COLUMNS, THROUGH, REST, LAST = 0, TILE, 2 * TILE, 3 * TILE
PLANES = 4 * TILE  # red, green, blue, depth
PATCH_STRIDE = 8 * TILE
STRIP_LABELS = STATE + 2 * PATCH_STRIDE  # [row, pixel, padded channels], twice; then fields and labels of each chunk


@part
def strip_floats(channels: int) -> int:
    return PATCH_HEIGHT * TILE * padded_channels(channels)


@part
def start_strip(columns: int, rows: int, labels: int, channels: int, scratch: Array) -> None:
    """Nothing blended yet; no transmittance outside the image, of which the strip has so many columns and rows."""
    left, right = zipped(lane_numbers(), lane_numbers())
    row, _ = zipped(spread(ZERO), spread(ONE))
    in_rows = row < spread(F(rows))
    for state, column in ((STATE, left), (STATE + PATCH_STRIDE, right)):
        inside = (column < spread(F(columns))) & in_rows
        store(scratch, state + COLUMNS, column)
        store(scratch, state + THROUGH, choose(inside, spread(ONE), spread(ZERO)))
        store(scratch, state + REST, spread(ONE))
        store(scratch, state + LAST, spread(-ONE))
        for plane in range(4):
            store(scratch, state + PLANES + plane * TILE, spread(ZERO))
    for at in range(labels, labels + strip_floats(channels), TILE):
        store(scratch, at, spread(ZERO))


@part
def fetch_row(pixel: int, layers: FlatLayers) -> None:
    """Have the lines brought that ``write_row`` will write: it would wait for one after the other."""
    image, alpha, depth, rest_out, last_out = layers
    fetch_to_write(alpha, pixel)
    fetch_to_write(depth, pixel)
    fetch_to_write(rest_out, pixel)
    fetch_to_write(last_out, pixel)
    for line in range(3):
        fetch_to_write(image, 3 * pixel + line * TILE)


@inlined
def rows_of(field: int, scratch: Array) -> Any:
    """A field of the strip's two patches as its two rows."""
    return unzipped(load(scratch, STATE + field), load(scratch, STATE + PATCH_STRIDE + field))


@part
def write_strip(pixel: int, columns: int, rows: int, width: int, scratch: Array, layers: FlatLayers) -> None:
    """The strip's pixels but for their labels: so many columns and rows, the first with the number ``pixel`` in the
    image."""
    upper_rest, lower_rest = rows_of(REST, scratch)
    upper_last, lower_last = rows_of(LAST, scratch)
    upper_red, lower_red = rows_of(PLANES, scratch)
    upper_green, lower_green = rows_of(PLANES + TILE, scratch)
    upper_blue, lower_blue = rows_of(PLANES + 2 * TILE, scratch)
    upper_depth, lower_depth = rows_of(PLANES + 3 * TILE, scratch)
    upper = (upper_rest, upper_last, upper_red, upper_green, upper_blue, upper_depth)
    lower = (lower_rest, lower_last, lower_red, lower_green, lower_blue, lower_depth)
    write_row(pixel, columns, upper, layers)
    if rows > 1:
        write_row(pixel + width, columns, lower, layers)


@inlined
def write_row(pixel: int, columns: int, state: Any, layers: FlatLayers) -> None:
    """One row of a strip."""
    image, alpha, depth, rest_out, last_out = layers
    rest, last, red, green, blue, own_depth = state
    inside = lane_numbers() < spread(F(columns))
    store_some(rest_out, pixel, rest, inside)
    store_some(alpha, pixel, spread(ONE) - rest, inside)
    store_some(depth, pixel, own_depth, inside)
    store_some(last_out, pixel, last, inside)
    write_colours(3 * pixel, 3 * columns, interleaved(red, green, blue), image)


@inlined
def write_colours(target: int, floats: int, colours: Any, image: Array) -> None:
    """A row's colours, pixel after pixel, to image[target : target + floats]."""
    first, second, third = colours
    store_some(image, target, first, lane_numbers() < spread(F(floats)))
    store_some(image, target + TILE, second, lane_numbers() < spread(F(floats - TILE)))
    store_some(image, target + 2 * TILE, third, lane_numbers() < spread(F(floats - 2 * TILE)))
