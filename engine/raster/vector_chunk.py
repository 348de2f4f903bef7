"""A chunk of a tile's Gaussians, side by side: on which of its pixels' rows does each one fall?

Sixteen Gaussians are whitened at once for one row, which costs a few cycles each and no branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import Array, part
from .records import (
    BLUE,
    CENTRE_X,
    CENTRE_X_LOW,
    CENTRE_Y,
    CENTRE_Y_LOW,
    CHUNK,
    DEPTH,
    GREEN,
    L11,
    L11_LOW,
    L12,
    L12_LOW,
    L22,
    L22_LOW,
    LOG_OPACITY,
    REACH_OVER_LOG_OPACITY,
    RECORD,
    RED,
    TILE,
)
from .vectors import bits_of, fetch, fma, get, load, maximum, put, spread, store

F = np.float32
ZERO = F(0.0)
LAST_LANE = F(TILE - 1)
AHEAD = 8
"""So many Gaussians before it is needed, a record is asked for: they lie anywhere in memory."""
NEVER = F(-1e30)

# fields of a chunk, in floats from where it lies; each has a place for every member
ORIGIN_S1, ORIGIN_S2 = 0, CHUNK  # s at the centre of the tile's first pixel
SLOPE, SHEAR, DROP = 2 * CHUNK, 3 * CHUNK, 4 * CHUNK  # L11, L12, L22
LOG_OPACITIES = 5 * CHUNK
REDS, GREENS, BLUES, DEPTHS = 6 * CHUNK, 7 * CHUNK, 8 * CHUNK, 9 * CHUNK
PLACES = 10 * CHUNK  # in the tile's list
CHUNK_FIELDS = 11 * CHUNK + TILE  # the last one has a place for nobody too

# fields of one row, in floats from where they lie
ROW_S1 = 0  # s1 at the row's first pixel
ROW_EXPONENTS = CHUNK  # log2(opacity) - s2^2
NOBODY = CHUNK
"""Stands for a member where there is none: ROW_EXPONENTS has a place for it, which lets it reach no pixel. What is read
of its other fields is of no consequence, but must be a number where it is multiplied: the first member's next field."""
ROW_FIELDS = 2 * CHUNK + TILE


@part
def origin_of(records: Array, at: int, left: int, top: int) -> Any:
    """s at the centre of a tile's first pixel: in double, once a tile; everything after is within a few standard
    deviations."""
    dx = (left + 0.5 - np.float64(get(records, at + CENTRE_X))) - np.float64(get(records, at + CENTRE_X_LOW))
    dy = (top + 0.5 - np.float64(get(records, at + CENTRE_Y))) - np.float64(get(records, at + CENTRE_Y_LOW))
    l11 = np.float64(get(records, at + L11)) + np.float64(get(records, at + L11_LOW))
    l12 = np.float64(get(records, at + L12)) + np.float64(get(records, at + L12_LOW))
    l22 = np.float64(get(records, at + L22)) + np.float64(get(records, at + L22_LOW))
    return F(l11 * dx + l12 * dy), F(l22 * dy)


@part
def load_chunk(
    tile_ids: Array, first: int, count: int, place: int, records: Array, left: int, top: int, fields: Array, base: int
) -> None:
    """The Gaussians tile_ids[first : first + count], of which the first has ``place`` in the tile's list, to
    fields[base:]. The members that are missing from the last sixteen reach no pixel."""
    for m in range(count):
        at = int(get(tile_ids, first + m)) * RECORD
        fetch(records, int(get(tile_ids, first + min(m + AHEAD, count - 1))) * RECORD)
        s1, s2 = origin_of(records, at, left, top)
        put(fields, base + ORIGIN_S1 + m, s1)
        put(fields, base + ORIGIN_S2 + m, s2)
        put(fields, base + SLOPE + m, get(records, at + L11))
        put(fields, base + SHEAR + m, get(records, at + L12))
        put(fields, base + DROP + m, get(records, at + L22))
        put(fields, base + LOG_OPACITIES + m, get(records, at + LOG_OPACITY))
        put(fields, base + REDS + m, get(records, at + RED))
        put(fields, base + GREENS + m, get(records, at + GREEN))
        put(fields, base + BLUES + m, get(records, at + BLUE))
        put(fields, base + DEPTHS + m, get(records, at + DEPTH))
        put(fields, base + PLACES + m, F(place + m))
    for m in range(count, (count + TILE - 1) // TILE * TILE):
        put(fields, base + LOG_OPACITIES + m, NEVER)


@part
def whiten_row(r: int, count: int, fields: Array, base: int, row_base: int) -> Any:
    """Fill the fields of row ``r`` from those of a chunk; returns the mask of the members that touch the row."""
    touching = 0
    row = spread(F(r))
    for m in range(0, count, TILE):
        at = base + m
        s1 = fma(load(fields, at + SHEAR), row, load(fields, at + ORIGIN_S1))
        s2 = fma(load(fields, at + DROP), row, load(fields, at + ORIGIN_S2))
        log_opacity = load(fields, at + LOG_OPACITIES)
        right = fma(load(fields, at + SLOPE), spread(LAST_LANE), s1)
        nearest = maximum(maximum(s1, spread(ZERO) - right), spread(ZERO))
        square = s2 * s2
        touches = fma(nearest, nearest, square) <= log_opacity + spread(REACH_OVER_LOG_OPACITY)
        store(fields, row_base + ROW_S1 + m, s1)
        store(fields, row_base + ROW_EXPONENTS + m, log_opacity - square)
        touching |= bits_of(touches) << m
    put(fields, row_base + ROW_EXPONENTS + NOBODY, NEVER)
    return touching


@part
def padded_channels(channels: int) -> int:
    """Channels in whole vectors."""
    return (channels + TILE - 1) // TILE * TILE
