"""Front-to-back blending, sixteen pixels at a time. The same steps as ``blend_forward``, its readable
twin."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import Array, compiled
from .conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from .products import BLOCK, ROWS, blend_1, blend_2, blend_3
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
    OPACITY,
    REACH,
    RECORD,
    RED,
    TILE,
)
from .vectors import (
    bits_of,
    choose,
    exp2,
    fma,
    lane_numbers,
    load,
    load_some,
    lowest_bit,
    maximum,
    minimum,
    negative_of,
    spread,
    store,
    store_some,
    take_next,
)

F = np.float32
ZERO, ONE = F(0.0), F(1.0)
ALPHA_CAP = F(ALPHA_MAX)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)
LAST_LANE = F(TILE - 1)
PIXELS = TILE * TILE

# a worker's scratch, in floats
S1_LEFT = 0
S2 = TILE
ROW_STATE = (
    2 * TILE
)  # [row, field, pixel]; a row's fields lie together, for arrays 4096 bytes apart get in each other's way
ROW_STRIDE = 8 * TILE
THROUGH = ROW_STATE
LAST = THROUGH + TILE
PLANES = LAST + TILE  # red, green, blue, depth
WEIGHTS = ROW_STATE + TILE * ROW_STRIDE  # [row, member, pixel]
CHUNK_LABELS = (
    WEIGHTS + TILE * CHUNK * TILE
)  # [member, padded channels], then the tile's [pixel, padded channels]


def padded_channels(channels: int) -> int:
    return -(-channels // TILE) * TILE


def scratch_size(channels: int) -> int:
    """Floats of scratch that a worker needs."""
    return CHUNK_LABELS + (CHUNK + PIXELS) * padded_channels(channels)


@compiled
def whiten_rows(records: Array, at: int, left: int, top: int, scratch: Array) -> Any:
    """s1 at the first pixel and s2 of each of the tile's rows, to scratch; returns the mask of the rows that
    are touched."""
    # the origin in double, once a tile: everything after is within a few standard deviations
    dx = (left + 0.5 - float(records[at + CENTRE_X])) - float(records[at + CENTRE_X_LOW])
    dy = (top + 0.5 - float(records[at + CENTRE_Y])) - float(records[at + CENTRE_Y_LOW])
    l11 = float(records[at + L11]) + float(records[at + L11_LOW])
    l12 = float(records[at + L12]) + float(records[at + L12_LOW])
    s1_origin = F(l11 * dx + l12 * dy)
    s2_origin = F((float(records[at + L22]) + float(records[at + L22_LOW])) * dy)
    s1_left = fma(spread(records[at + L12]), lane_numbers(), spread(s1_origin))
    s2 = fma(spread(records[at + L22]), lane_numbers(), spread(s2_origin))
    store(scratch, S1_LEFT, s1_left)
    store(scratch, S2, s2)
    s1_right = s1_left + spread(records[at + L11] * LAST_LANE)
    nearest = maximum(maximum(s1_left, spread(ZERO) - s1_right), spread(ZERO))
    return bits_of(fma(nearest, nearest, s2 * s2) <= spread(records[at + REACH]))


@compiled
def start_tile(width: int, height: int, left: int, top: int, scratch: Array) -> Any:
    """Transmittance one inside the image, minus one (ended) outside. Returns the mask of rows inside."""
    inside = lane_numbers() < spread(F(width - left))
    alive = 0
    for r in range(TILE):
        if top + r < height:
            store(scratch, THROUGH + r * ROW_STRIDE, choose(inside, spread(ONE), spread(-ONE)))
            alive |= 1 << r
        else:
            store(scratch, THROUGH + r * ROW_STRIDE, spread(-ONE))
        store(scratch, LAST + r * ROW_STRIDE, spread(-ONE))
        for plane in range(4):
            store(scratch, PLANES + plane * TILE + r * ROW_STRIDE, spread(ZERO))
    return alive


@compiled
def copy_labels(gaussian: int, labels: Array, channels: int, scratch: Array, at: int) -> None:
    """One Gaussian's labels, padded with zeros to whole vectors."""
    source = gaussian * channels
    for c in range(0, channels - TILE + 1, TILE):
        store(scratch, at + c, load(labels, source + c))
    rest = channels % TILE
    if rest > 0:
        c = channels - rest
        store(scratch, at + c, load_some(labels, source + c, lane_numbers() < spread(F(rest))))


@compiled
def blend_gaussian(
    records: Array,
    at: int,
    place: float,
    member: int,
    rows: int,
    alive: int,
    scratch: Array,
    counts: Array,
    members: Array,
) -> Any:
    """Blend one Gaussian on the rows of a mask; returns the rows that still see anything."""
    slope = spread(records[at + L11])
    opacity = spread(records[at + OPACITY])
    red, green = spread(records[at + RED]), spread(records[at + GREEN])
    blue, depth = spread(records[at + BLUE]), spread(records[at + DEPTH])
    while rows != 0:
        r = lowest_bit(rows)
        rows &= rows - 1
        row = r * ROW_STRIDE
        s1 = fma(slope, lane_numbers(), spread(scratch[S1_LEFT + r]))
        s2 = spread(scratch[S2 + r])
        alpha = minimum(opacity * exp2(spread(ZERO) - fma(s1, s1, s2 * s2)), spread(ALPHA_CAP))
        through = load(scratch, THROUGH + row)
        weight = alpha * through
        after = through * (spread(ONE) - alpha)
        seen = alpha >= spread(ALPHA_LEAST)
        blended = seen & (after > spread(ENDED))
        through = choose(blended, after, choose(seen, negative_of(through), through))
        store(scratch, THROUGH + row, through)
        if bits_of(blended) == 0:
            if bits_of(through > spread(ZERO)) == 0:
                alive &= ~(1 << r)
            continue
        weight = choose(blended, weight, spread(ZERO))
        store(scratch, LAST + row, choose(blended, spread(place), load(scratch, LAST + row)))
        store(scratch, PLANES + row, fma(weight, red, load(scratch, PLANES + row)))
        store(scratch, PLANES + TILE + row, fma(weight, green, load(scratch, PLANES + TILE + row)))
        store(scratch, PLANES + 2 * TILE + row, fma(weight, blue, load(scratch, PLANES + 2 * TILE + row)))
        store(scratch, PLANES + 3 * TILE + row, fma(weight, depth, load(scratch, PLANES + 3 * TILE + row)))
        store(scratch, WEIGHTS + (r * CHUNK + counts[r]) * TILE, weight)
        members[r * CHUNK + counts[r]] = member
        counts[r] += 1
    return alive


@compiled
def add_labels(scratch: Array, counts: Array, members: Array, padded: int) -> None:
    """The tile's labels += the chunk's weights times its labels, row after row, eight pixels times three
    vectors at a time."""
    tile_labels = CHUNK_LABELS + CHUNK * padded
    for r in range(TILE):
        count = counts[r]
        counts[r] = 0
        if count == 0:
            continue
        listed = r * CHUNK
        for x in range(0, TILE, ROWS):
            weights = WEIGHTS + listed * TILE + x
            out = tile_labels + (r * TILE + x) * padded
            c = 0
            while c + 3 * BLOCK <= padded:
                blend_3(
                    scratch,
                    out + c,
                    scratch,
                    CHUNK_LABELS + c,
                    members,
                    listed,
                    scratch,
                    weights,
                    count,
                    padded,
                )
                c += 3 * BLOCK
            if c + 2 * BLOCK <= padded:
                blend_2(
                    scratch,
                    out + c,
                    scratch,
                    CHUNK_LABELS + c,
                    members,
                    listed,
                    scratch,
                    weights,
                    count,
                    padded,
                )
            elif c + BLOCK <= padded:
                blend_1(
                    scratch,
                    out + c,
                    scratch,
                    CHUNK_LABELS + c,
                    members,
                    listed,
                    scratch,
                    weights,
                    count,
                    padded,
                )


@compiled
def write_tile(
    left: int,
    top: int,
    width: int,
    height: int,
    channels: int,
    scratch: Array,
    image: Array,
    labels_out: Array,
    alpha: Array,
    depth: Array,
    rest: Array,
    last_out: Array,
) -> None:
    padded = (channels + TILE - 1) // TILE * TILE
    inside = lane_numbers() < spread(F(width - left))
    tail = channels % TILE
    in_tail = lane_numbers() < spread(F(tail))
    for r in range(min(TILE, height - top)):
        row = r * ROW_STRIDE
        pixel = (top + r) * width + left
        through = maximum(load(scratch, THROUGH + row), spread(ZERO) - load(scratch, THROUGH + row))
        store_some(rest, pixel, through, inside)
        store_some(alpha, pixel, spread(ONE) - through, inside)
        store_some(depth, pixel, load(scratch, PLANES + 3 * TILE + row), inside)
        store_some(last_out, pixel, load(scratch, LAST + row), inside)
        for x in range(min(TILE, width - left)):
            for plane in range(3):
                image[3 * (pixel + x) + plane] = scratch[PLANES + plane * TILE + row + x]
        if channels == 0:
            continue
        for x in range(min(TILE, width - left)):
            source = CHUNK_LABELS + (CHUNK + r * TILE + x) * padded
            target = (pixel + x) * channels
            for c in range(0, channels - TILE + 1, TILE):
                store(labels_out, target + c, load(scratch, source + c))
            if tail > 0:
                store_some(
                    labels_out, target + channels - tail, load(scratch, source + channels - tail), in_tail
                )


@compiled
def blend_tiles(
    worker: int,
    workers: int,
    next_tile: Array,
    starts: Array,
    tile_ids: Array,
    records: Array,
    labels: Array,
    channels: int,
    width: int,
    height: int,
    image: Array,
    labels_out: Array,
    alpha: Array,
    depth: Array,
    rest: Array,
    last_out: Array,
    scratches: Array,
    member_lists: Array,
    row_counts: Array,
) -> None:
    """Tile after tile until none is left. ``rest`` [H * W] gets the final transmittance, ``last_out`` [H * W]
    (as float32) the place in the tile's list of the last Gaussian blended (-1: none)."""
    scratch, members, counts = scratches[worker], member_lists[worker], row_counts[worker]
    columns = (width + TILE - 1) // TILE
    tiles = starts.shape[0] - 1
    padded = (channels + TILE - 1) // TILE * TILE
    for r in range(TILE):
        counts[r] = 0
    while True:
        tile = take_next(next_tile)
        if tile >= tiles:
            break
        left = tile % columns * TILE
        top = tile // columns * TILE
        alive = start_tile(width, height, left, top, scratch)
        for at in range(CHUNK_LABELS + CHUNK * padded, CHUNK_LABELS + (CHUNK + PIXELS) * padded, TILE):
            store(scratch, at, spread(ZERO))
        first, end = starts[tile], starts[tile + 1]
        for chunk in range(first, end, CHUNK):
            for k in range(chunk, min(chunk + CHUNK, end)):
                gaussian = int(tile_ids[k])
                at = gaussian * RECORD
                rows = whiten_rows(records, at, left, top, scratch) & alive
                if rows == 0:
                    continue
                alive = blend_gaussian(
                    records, at, F(k - first), k - chunk, rows, alive, scratch, counts, members
                )
                if channels > 0:
                    copy_labels(gaussian, labels, channels, scratch, CHUNK_LABELS + (k - chunk) * padded)
            if channels > 0:
                add_labels(scratch, counts, members, padded)
            else:
                for r in range(TILE):
                    counts[r] = 0
            if alive == 0:
                break
        write_tile(
            left, top, width, height, channels, scratch, image, labels_out, alpha, depth, rest, last_out
        )
