"""Front-to-back blending, sixteen pixels of a row at a time. The same steps as ``blend_forward``, its readable
twin.

A row of a tile takes all members of a chunk one after the other, its state in registers, then adds up their labels
while the weights are still in the first cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import Array, compiled, inlined, part
from .conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from .products import BLOCK, ROWS, blend_1, blend_2, blend_3
from .records import CHUNK, TILE
from .vector_chunk import (
    BLUES,
    CHUNK_FIELDS,
    DEPTHS,
    GREENS,
    NOBODY,
    PLACES,
    REDS,
    ROW_EXPONENTS,
    ROW_FIELDS,
    ROW_S1,
    SLOPE,
    load_chunk,
    padded_channels,
    whiten_row,
)
from .vectors import (
    bits_of,
    choose,
    everywhere,
    exp2_of_four,
    fetch,
    fetch_to_write,
    fma,
    get,
    interleaved,
    is_aligned,
    lane_numbers,
    less_product,
    load,
    load_some,
    lowest_bit,
    maximum,
    minimum,
    put,
    spread,
    store,
    store_past_cache,
    store_some,
    take_next,
)

F = np.float32
ZERO, ONE = F(0.0), F(1.0)
ALPHA_CAP = F(ALPHA_MAX)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)
NEARLY_NOTHING = F(1e-20)
"""A transmittance is not multiplied further down: subnormal numbers are slow."""

# a worker's scratch, in floats
ROW = 0  # of the row at hand: what its members are there
WEIGHTS = ROW + ROW_FIELDS  # [member, pixel], with room for those that turn out not to be blended
STATE = WEIGHTS + (CHUNK + 4) * TILE  # [field, pixel]
THROUGH = STATE
REST = THROUGH + TILE
LAST = REST + TILE
PLANES = LAST + TILE  # red, green, blue, depth
ROW_LABELS = PLANES + 4 * TILE  # [pixel, padded channels], twice; then the fields and the labels of each chunk
LINES_AT_ONCE = 12
"""Cache lines that a core can have under way to memory: with more of them it waits."""


@part
def chunk_floats(channels: int) -> int:
    return CHUNK_FIELDS + CHUNK * padded_channels(channels)


def scratch_size(channels: int, longest: int) -> int:
    """Floats of scratch that a worker needs when the longest list of a tile has so many Gaussians."""
    floats: int = ROW_LABELS + 2 * TILE * padded_channels(channels) + -(-longest // CHUNK) * chunk_floats(channels)
    return floats


@part
def start_row(left: int, width: int, padded: int, row_labels: int, scratch: Array) -> None:
    """Nothing blended yet; no transmittance outside the image."""
    inside = lane_numbers() < spread(F(width - left))
    store(scratch, THROUGH, choose(inside, spread(ONE), spread(ZERO)))
    store(scratch, REST, spread(ONE))
    store(scratch, LAST, spread(-ONE))
    for plane in range(4):
        store(scratch, PLANES + plane * TILE, spread(ZERO))
    for at in range(row_labels, row_labels + TILE * padded, TILE):
        store(scratch, at, spread(ZERO))


@part
def fetch_row(
    pixel: int, image: Array, alpha: Array, depth: Array, rest_out: Array, last_out: Array
) -> None:
    """Have the lines brought that ``write_row`` will write: it would wait for one after the other."""
    fetch_to_write(alpha, pixel)
    fetch_to_write(depth, pixel)
    fetch_to_write(rest_out, pixel)
    fetch_to_write(last_out, pixel)
    for line in range(3):
        fetch_to_write(image, 3 * pixel + line * TILE)


@part
def copy_labels(gaussian: int, labels: Array, channels: int, scratch: Array, at: int) -> None:
    """One Gaussian's labels, padded with zeros to whole vectors."""
    source = gaussian * channels
    for c in range(0, channels - TILE + 1, TILE):
        store(scratch, at + c, load(labels, source + c))
    rest = channels % TILE
    if rest > 0:
        c = channels - rest
        store(scratch, at + c, load_some(labels, source + c, lane_numbers() < spread(F(rest))))


@inlined
def exponent_of(m: int, scratch: Array, fields: int) -> Any:
    """log2 of a member's alpha on the row."""
    s1 = fma(everywhere(scratch, fields + SLOPE + m), lane_numbers(), everywhere(scratch, ROW + ROW_S1 + m))
    return less_product(s1, s1, everywhere(scratch, ROW + ROW_EXPONENTS + m))


@inlined
def seen_alpha(raw: Any) -> Any:
    """The alpha that counts: at most 0.99, 0 where it is too small."""
    return choose(raw >= spread(ALPHA_LEAST), minimum(raw, spread(ALPHA_CAP)), spread(ZERO))


@inlined
def blend_member(m: int, alpha: Any, state: Any, count: int, scratch: Array, fields: int, members: Array) -> Any:
    """Blend one member; returns the row's new state, and how many members have been blended so far.

    A pixel has ended once its transmittance is too small; the product goes on, and says so of all that follow.
    """
    through, rest, last, red, green, blue, depth = state
    after = less_product(alpha, through, through)
    blended = (alpha > spread(ZERO)) & (after > spread(ENDED))
    weight = choose(blended, alpha * through, spread(ZERO))
    rest = choose(blended, after, rest)
    last = choose(blended, everywhere(scratch, fields + PLACES + m), last)
    red = fma(weight, everywhere(scratch, fields + REDS + m), red)
    green = fma(weight, everywhere(scratch, fields + GREENS + m), green)
    blue = fma(weight, everywhere(scratch, fields + BLUES + m), blue)
    depth = fma(weight, everywhere(scratch, fields + DEPTHS + m), depth)
    # written over by the next one where nothing was blended: cheaper than a branch that nobody can foresee
    store(scratch, WEIGHTS + count * TILE, weight)
    put(members, count, np.int32(m))
    return (after, rest, last, red, green, blue, depth), count + int(bits_of(blended) != 0)


@part
def blend_row(touching: int, scratch: Array, fields: int, members: Array) -> Any:
    """Blend the members of a mask on the row, four at a time, so that one does not wait for the other's alpha.

    Weights and ``members`` hold those that were blended anywhere, in order; returns how many, and whether the row
    still sees anything.
    """
    state = (
        load(scratch, THROUGH),
        load(scratch, REST),
        load(scratch, LAST),
        load(scratch, PLANES),
        load(scratch, PLANES + TILE),
        load(scratch, PLANES + 2 * TILE),
        load(scratch, PLANES + 3 * TILE),
    )
    count = 0
    sees = True
    while sees and touching != 0:
        m0 = lowest_bit(touching)
        touching &= touching - 1
        m1 = min(lowest_bit(touching), NOBODY)
        touching &= touching - 1
        m2 = min(lowest_bit(touching), NOBODY)
        touching &= touching - 1
        m3 = min(lowest_bit(touching), NOBODY)
        touching &= touching - 1
        e0, e1 = exponent_of(m0, scratch, fields), exponent_of(m1, scratch, fields)
        e2, e3 = exponent_of(m2, scratch, fields), exponent_of(m3, scratch, fields)
        raw0, raw1, raw2, raw3 = exp2_of_four(e0, e1, e2, e3)
        alpha0, alpha1, alpha2, alpha3 = seen_alpha(raw0), seen_alpha(raw1), seen_alpha(raw2), seen_alpha(raw3)
        state, count = blend_member(m0, alpha0, state, count, scratch, fields, members)
        state, count = blend_member(m1, alpha1, state, count, scratch, fields, members)
        state, count = blend_member(m2, alpha2, state, count, scratch, fields, members)
        state, count = blend_member(m3, alpha3, state, count, scratch, fields, members)
        through, rest, last, red, green, blue, depth = state
        state = (maximum(through, spread(NEARLY_NOTHING)), rest, last, red, green, blue, depth)
        sees = bits_of(through > spread(ENDED)) != 0
    through, rest, last, red, green, blue, depth = state
    store(scratch, THROUGH, through)
    store(scratch, REST, rest)
    store(scratch, LAST, last)
    store(scratch, PLANES, red)
    store(scratch, PLANES + TILE, green)
    store(scratch, PLANES + 2 * TILE, blue)
    store(scratch, PLANES + 3 * TILE, depth)
    return count, sees


@part
def add_row_labels(count: int, row_labels: int, scratch: Array, labels: int, members: Array, padded: int) -> None:
    """The labels of the row's pixels += its weights times a chunk's labels, a few pixels times three vectors at a
    time."""
    for x in range(0, TILE, ROWS):
        out = row_labels + x * padded
        weights = WEIGHTS + x
        c = 0
        while c + 3 * BLOCK <= padded:
            blend_3(scratch, out + c, scratch, labels + c, members, 0, scratch, weights, count, padded)
            c += 3 * BLOCK
        if c + 2 * BLOCK <= padded:
            blend_2(scratch, out + c, scratch, labels + c, members, 0, scratch, weights, count, padded)
        elif c + BLOCK <= padded:
            blend_1(scratch, out + c, scratch, labels + c, members, 0, scratch, weights, count, padded)


@part
def fetch_labels(first: int, count: int, tile_ids: Array, labels: Array, channels: int) -> None:
    """Have the labels of a chunk brought: they lie anywhere in memory, and will be needed soon."""
    for m in range(count):
        source = int(get(tile_ids, first + m)) * channels
        for c in range(0, channels, TILE):
            fetch(labels, source + c)
        fetch(labels, source + channels - 1)


@part
def copy_touching(
    touching: int,
    first: int,
    tile_ids: Array,
    labels: Array,
    channels: int,
    scratch: Array,
    at: int,
    copied: Array,
    c: int,
) -> None:
    """The labels of a chunk's members that no row before has touched, to scratch[at:]."""
    fresh = touching & ~get(copied, c)
    put(copied, c, get(copied, c) | touching)
    while fresh != 0:
        m = lowest_bit(fresh)
        fresh &= fresh - 1
        gaussian = int(get(tile_ids, first + m))
        copy_labels(gaussian, labels, channels, scratch, at + m * padded_channels(channels))


@part
def write_colours(target: int, floats: int, scratch: Array, image: Array) -> None:
    """The row's colours, pixel after pixel, to image[target : target + floats]."""
    first, second, third = interleaved(
        load(scratch, PLANES), load(scratch, PLANES + TILE), load(scratch, PLANES + 2 * TILE)
    )
    store_some(image, target, first, lane_numbers() < spread(F(floats)))
    store_some(image, target + TILE, second, lane_numbers() < spread(F(floats - TILE)))
    store_some(image, target + 2 * TILE, third, lane_numbers() < spread(F(floats - 2 * TILE)))


@part
def write_row(
    pixel: int,
    pixels: int,
    scratch: Array,
    image: Array,
    alpha: Array,
    depth: Array,
    rest_out: Array,
    last_out: Array,
) -> None:
    """The row's pixels but for their labels; the first has the number ``pixel`` in the image."""
    inside = lane_numbers() < spread(F(pixels))
    rest = load(scratch, REST)
    store_some(rest_out, pixel, rest, inside)
    store_some(alpha, pixel, spread(ONE) - rest, inside)
    store_some(depth, pixel, load(scratch, PLANES + 3 * TILE), inside)
    store_some(last_out, pixel, load(scratch, LAST), inside)
    write_colours(3 * pixel, 3 * pixels, scratch, image)


@part
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
        rest = lane_numbers() < spread(F(floats - at))
        store_some(labels_out, target + at, load(scratch, row_labels + at), rest)
    return lines


@inlined
def flush_lines(lines: int, most: int, source: int, target: int, scratch: Array, labels_out: Array) -> Any:
    """Write at most so many of the ``lines`` whose first is scratch[source], the last ones first, past the cache.
    Returns how many are left."""
    left = max(lines - most, 0)
    for line in range(left, lines):
        store_past_cache(labels_out, target + line * TILE, load(scratch, source + line * TILE))
    return left


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
    masks: Array,
) -> None:
    """Tile after tile until none is left. ``rest`` [H * W] gets the final transmittance, ``last_out`` [H * W]
    (as float32) the place in the tile's list of the last Gaussian blended (-1: none)."""
    scratch, members, copied = scratches[worker], member_lists[worker], masks[worker]
    columns = (width + TILE - 1) // TILE
    tiles = starts.shape[0] - 1
    padded = padded_channels(channels)
    chunks = ROW_LABELS + 2 * TILE * padded
    row_labels = ROW_LABELS
    # the labels of the row before: they go to memory, a few lines at a time, while this row is computed
    lines, source, target = 0, 0, 0
    while True:
        tile = take_next(next_tile)
        if tile >= tiles:
            break
        left = tile % columns * TILE
        top = tile // columns * TILE
        pixels = min(TILE, width - left)
        first, total = starts[tile], starts[tile + 1] - starts[tile]
        loaded = 0
        for r in range(min(TILE, height - top)):
            pixel = (top + r) * width + left
            fetch_row(pixel, image, alpha, depth, rest, last_out)
            start_row(left, width, padded, row_labels, scratch)
            for place in range(0, total, CHUNK):
                c = place // CHUNK
                fields = chunks + c * chunk_floats(channels)
                count = min(CHUNK, total - place)
                if place == loaded:
                    if channels > 0:
                        fetch_labels(first + place, count, tile_ids, labels, channels)
                    load_chunk(tile_ids, first + place, count, place, records, left, top, scratch, fields)
                    put(copied, c, 0)
                    loaded += CHUNK
                touching = whiten_row(r, count, scratch, fields, ROW)
                lines = flush_lines(lines, LINES_AT_ONCE, source, target, scratch, labels_out)
                blended, sees = blend_row(touching, scratch, fields, members)
                lines = flush_lines(lines, LINES_AT_ONCE, source, target, scratch, labels_out)
                if channels > 0 and blended > 0:
                    own_labels = fields + CHUNK_FIELDS
                    copy_touching(
                        touching, first + place, tile_ids, labels, channels, scratch, own_labels, copied, c
                    )
                    add_row_labels(blended, row_labels, scratch, own_labels, members, padded)
                    lines = flush_lines(lines, LINES_AT_ONCE, source, target, scratch, labels_out)
                if not sees:
                    break
            write_row(pixel, pixels, scratch, image, alpha, depth, rest, last_out)
            flush_lines(lines, lines, source, target, scratch, labels_out)
            if channels > 0:
                source, target = row_labels, pixel * channels
                lines = pack_labels(target, pixels, channels, row_labels, scratch, labels_out)
                row_labels = ROW_LABELS + TILE * padded - (row_labels - ROW_LABELS)
    flush_lines(lines, lines, source, target, scratch, labels_out)
    take_next(next_tile)  # an atomic operation: all that went past the cache is there before anybody reads it
