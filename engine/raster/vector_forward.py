"""Front-to-back blending, a patch of sixteen pixels at a time. The same steps as ``blend_forward``, its readable
twin.

A patch takes all members of a chunk one after the other, its state in registers, then adds up their labels while the
weights are still in the first cache. Two patches side by side make a strip of a tile, which is written row by row.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..machine.compiled import Array, compiled, inlined, part
from ..machine.vector_functions import exp2_of_four
from ..machine.vector_shuffles import interleaved, unzipped, zipped
from ..machine.vectors import (
    bits_of,
    choose,
    everywhere,
    fetch,
    fetch_to_write,
    fma,
    get,
    is_aligned,
    lane_numbers,
    less_product,
    load,
    load_some,
    lowest_bit,
    maximum,
    minimum,
    pairs,
    put,
    spread,
    store,
    store_past_cache,
    store_some,
    take_next,
)
from .conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from .products import BLOCK, ROWS, blend_1, blend_2, blend_3
from .records import CHUNK, PATCH_HEIGHT, PATCH_WIDTH, TILE
from .vector_chunk import (
    BLUES,
    CHUNK_FIELDS,
    DEPTHS,
    GREENS,
    NOBODY,
    PLACES,
    REDS,
    SLOPE,
    STRIP_EXPONENTS,
    STRIP_FIELDS,
    STRIP_S1,
    load_chunk,
    padded_channels,
    whiten_strip,
)

F = np.float32
ZERO, ONE = F(0.0), F(1.0)
ALPHA_CAP = F(ALPHA_MAX)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)
NEARLY_NOTHING = F(1e-20)
"""A transmittance is not multiplied further down: subnormal numbers are slow."""

# a worker's scratch, in floats
STRIP = 0  # of the strip at hand: what its members are there
WEIGHTS = STRIP + STRIP_FIELDS  # [member, pixel of the patch], with room for those that turn out not to be blended
STATE = WEIGHTS + (CHUNK + 4) * TILE  # [patch, field, pixel]
COLUMNS, THROUGH, REST, LAST = 0, TILE, 2 * TILE, 3 * TILE
PLANES = 4 * TILE  # red, green, blue, depth
PATCH_STATE = 8 * TILE
STRIP_LABELS = STATE + 2 * PATCH_STATE  # [row, pixel, padded channels], twice; then fields and labels of each chunk
LINES_AT_ONCE = 12
"""Cache lines that a core can have under way to memory: with more of them it waits."""


@part
def chunk_floats(channels: int) -> int:
    return CHUNK_FIELDS + CHUNK * padded_channels(channels)


@part
def strip_floats(channels: int) -> int:
    return PATCH_HEIGHT * TILE * padded_channels(channels)


def scratch_size(channels: int, longest: int) -> int:
    """Floats of scratch that a worker needs when the longest list of a tile has so many Gaussians."""
    floats: int = STRIP_LABELS + 2 * strip_floats(channels) + -(-longest // CHUNK) * chunk_floats(channels)
    return floats


@part
def start_strip(columns: int, rows: int, labels: int, channels: int, scratch: Array) -> None:
    """Nothing blended yet; no transmittance outside the image, of which the strip has so many columns and rows."""
    left, right = zipped(lane_numbers(), lane_numbers())
    row, _ = zipped(spread(ZERO), spread(ONE))
    in_rows = row < spread(F(rows))
    for state, column in ((STATE, left), (STATE + PATCH_STATE, right)):
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
def exponent_of(m: int, columns: Any, scratch: Array, fields: int) -> Any:
    """log2 of a member's alpha on the patch."""
    s1 = fma(everywhere(scratch, fields + SLOPE + m), columns, pairs(scratch, STRIP + STRIP_S1 + 2 * m))
    return less_product(s1, s1, pairs(scratch, STRIP + STRIP_EXPONENTS + 2 * m))


@inlined
def seen_alpha(raw: Any) -> Any:
    """The alpha that counts: at most 0.99, 0 where it is too small."""
    return choose(raw >= spread(ALPHA_LEAST), minimum(raw, spread(ALPHA_CAP)), spread(ZERO))


@inlined
def blend_member(m: int, alpha: Any, state: Any, count: int, scratch: Array, fields: int, members: Array) -> Any:
    """Blend one member; returns the patch's new state, and how many members have been blended so far.

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


@inlined
def take_four(mask: int, missing: int) -> Any:
    """The four lowest bits of a mask, ``missing`` for those that there are not; and the mask without them."""
    first = lowest_bit(mask)
    mask &= mask - 1
    second = min(lowest_bit(mask), missing)
    mask &= mask - 1
    third = min(lowest_bit(mask), missing)
    mask &= mask - 1
    fourth = min(lowest_bit(mask), missing)
    mask &= mask - 1
    return (first, second, third, fourth), mask


@inlined
def alphas_of(four: Any, columns: Any, scratch: Array, fields: int) -> Any:
    """The alphas that count of four members, side by side."""
    m0, m1, m2, m3 = four
    e0, e1 = exponent_of(m0, columns, scratch, fields), exponent_of(m1, columns, scratch, fields)
    e2, e3 = exponent_of(m2, columns, scratch, fields), exponent_of(m3, columns, scratch, fields)
    raw0, raw1, raw2, raw3 = exp2_of_four(e0, e1, e2, e3)
    return seen_alpha(raw0), seen_alpha(raw1), seen_alpha(raw2), seen_alpha(raw3)


@inlined
def blend_four(
    four: Any, alphas: Any, state: Any, count: int, scratch: Array, fields: int, members: Array
) -> Any:
    """Blend four members, one after the other; as ``blend_member``, and whether the patch still sees anything."""
    m0, m1, m2, m3 = four
    alpha0, alpha1, alpha2, alpha3 = alphas
    state, count = blend_member(m0, alpha0, state, count, scratch, fields, members)
    state, count = blend_member(m1, alpha1, state, count, scratch, fields, members)
    state, count = blend_member(m2, alpha2, state, count, scratch, fields, members)
    state, count = blend_member(m3, alpha3, state, count, scratch, fields, members)
    through, rest, last, red, green, blue, depth = state
    sees = bits_of(through > spread(ENDED)) != 0
    return (maximum(through, spread(NEARLY_NOTHING)), rest, last, red, green, blue, depth), count, sees


@part
def blend_patch(touching: int, at: int, scratch: Array, fields: int, members: Array) -> Any:
    """Blend the members of a mask on the patch whose state lies at scratch[at:], four at a time, so that one does not
    wait for the other's alpha.

    Weights and ``members`` hold those that were blended anywhere, in order; returns how many, and whether the patch
    still sees anything.
    """
    columns = load(scratch, at + COLUMNS)
    state = (
        load(scratch, at + THROUGH),
        load(scratch, at + REST),
        load(scratch, at + LAST),
        load(scratch, at + PLANES),
        load(scratch, at + PLANES + TILE),
        load(scratch, at + PLANES + 2 * TILE),
        load(scratch, at + PLANES + 3 * TILE),
    )
    count = 0
    sees = bits_of(state[0] > spread(ENDED)) != 0
    if sees and touching != 0:
        four, touching = take_four(touching, NOBODY)
        alphas = alphas_of(four, columns, scratch, fields)
        while sees and touching != 0:
            # the next four's alphas beside the blending of these: neither waits for the other
            next_four, touching = take_four(touching, NOBODY)
            next_alphas = alphas_of(next_four, columns, scratch, fields)
            state, count, sees = blend_four(four, alphas, state, count, scratch, fields, members)
            four, alphas = next_four, next_alphas
        if sees:
            state, count, sees = blend_four(four, alphas, state, count, scratch, fields, members)
    through, rest, last, red, green, blue, depth = state
    store(scratch, at + THROUGH, through)
    store(scratch, at + REST, rest)
    store(scratch, at + LAST, last)
    store(scratch, at + PLANES, red)
    store(scratch, at + PLANES + TILE, green)
    store(scratch, at + PLANES + 2 * TILE, blue)
    store(scratch, at + PLANES + 3 * TILE, depth)
    return count, sees


@part
def add_patch_labels(
    count: int, patch_labels: int, scratch: Array, labels: int, members: Array, padded: int
) -> None:
    """The labels of a patch's pixels, the first of which lie at scratch[patch_labels:], += its weights times a chunk's
    labels, a few pixels of a row times three vectors at a time."""
    for row in range(PATCH_HEIGHT):
        for x in range(0, PATCH_WIDTH, ROWS):
            out = patch_labels + (row * TILE + x) * padded
            weights = WEIGHTS + PATCH_HEIGHT * x + row
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
    """The labels of a chunk's members that no patch before has touched, to scratch[at:]."""
    fresh = touching & ~get(copied, c)
    put(copied, c, get(copied, c) | touching)
    while fresh != 0:
        m = lowest_bit(fresh)
        fresh &= fresh - 1
        gaussian = int(get(tile_ids, first + m))
        copy_labels(gaussian, labels, channels, scratch, at + m * padded_channels(channels))


@inlined
def rows_of(field: int, scratch: Array) -> Any:
    """A field of the strip's two patches as its two rows."""
    return unzipped(load(scratch, STATE + field), load(scratch, STATE + PATCH_STATE + field))


@part
def write_strip(
    pixel: int,
    columns: int,
    rows: int,
    width: int,
    scratch: Array,
    image: Array,
    alpha: Array,
    depth: Array,
    rest_out: Array,
    last_out: Array,
) -> None:
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
    write_row(pixel, columns, upper, image, alpha, depth, rest_out, last_out)
    if rows > 1:
        write_row(pixel + width, columns, lower, image, alpha, depth, rest_out, last_out)


@inlined
def write_row(
    pixel: int,
    columns: int,
    state: Any,
    image: Array,
    alpha: Array,
    depth: Array,
    rest_out: Array,
    last_out: Array,
) -> None:
    """One row of a strip."""
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
def flush_some(lines: int, most: int, source: int, target: int, scratch: Array, labels_out: Array) -> Any:
    """Write at most so many of the ``lines`` whose first is scratch[source], the last ones first, past the cache.
    Returns how many are left."""
    left = max(lines - most, 0)
    for line in range(left, lines):
        store_past_cache(labels_out, target + line * TILE, load(scratch, source + line * TILE))
    return left


@part
def flush_lines(
    lines: Any, most: int, source: int, target: int, row: int, padded_row: int, scratch: Array, labels_out: Array
) -> Any:
    """As ``flush_some`` for the two rows of a strip, the lower one first; the lines that are left of each."""
    upper, lower = lines
    if lower > 0:
        return upper, flush_some(lower, most, source + padded_row, target + row, scratch, labels_out)
    return flush_some(upper, most, source, target, scratch, labels_out), lower


@inlined
def flush_all(
    lines: Any, source: int, target: int, row: int, padded_row: int, scratch: Array, labels_out: Array
) -> None:
    """All that is left of a strip."""
    upper, lower = lines
    flush_some(lower, lower, source + padded_row, target + row, scratch, labels_out)
    flush_some(upper, upper, source, target, scratch, labels_out)


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
    chunks = STRIP_LABELS + 2 * strip_floats(channels)
    strip_labels = STRIP_LABELS
    # the labels of the strip before: they go to memory, a few lines at a time, while this one is computed
    lines, source, target = (0, 0), 0, 0
    row, padded_row = width * channels, TILE * padded
    while True:
        tile = take_next(next_tile)
        if tile >= tiles:
            break
        left = tile % columns * TILE
        top = tile // columns * TILE
        pixels = min(TILE, width - left)
        first, total = starts[tile], starts[tile + 1] - starts[tile]
        loaded = 0
        for r in range(0, min(TILE, height - top), PATCH_HEIGHT):
            rows = min(PATCH_HEIGHT, height - top - r)
            pixel = (top + r) * width + left
            for own in range(rows):
                fetch_row(pixel + own * width, image, alpha, depth, rest, last_out)
            start_strip(pixels, rows, strip_labels, channels, scratch)
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
                touching = whiten_strip(r, count, scratch, fields, STRIP)
                strip_sees = False
                for patch in range(2):
                    blended, sees = blend_patch(touching[patch], STATE + patch * PATCH_STATE, scratch, fields, members)
                    strip_sees |= sees
                    lines = flush_lines(
                        lines, LINES_AT_ONCE, source, target, row, padded_row, scratch, labels_out
                    )
                    if channels > 0 and blended > 0:
                        own_labels = fields + CHUNK_FIELDS
                        copy_touching(
                            touching[patch], first + place, tile_ids, labels, channels, scratch, own_labels, copied, c
                        )
                        patch_labels = strip_labels + patch * PATCH_WIDTH * padded
                        add_patch_labels(blended, patch_labels, scratch, own_labels, members, padded)
                        lines = flush_lines(
                            lines, LINES_AT_ONCE, source, target, row, padded_row, scratch, labels_out
                        )
                if not strip_sees:
                    break
            write_strip(pixel, pixels, rows, width, scratch, image, alpha, depth, rest, last_out)
            flush_all(lines, source, target, row, padded_row, scratch, labels_out)
            if channels > 0:
                source, target = strip_labels, pixel * channels
                upper = pack_labels(target, pixels, channels, source, scratch, labels_out)
                lower = 0
                if rows > 1:
                    lower = pack_labels(target + row, pixels, channels, source + padded_row, scratch, labels_out)
                lines = upper, lower
                strip_labels = 2 * STRIP_LABELS + strip_floats(channels) - strip_labels  # the other one
    flush_all(lines, source, target, row, padded_row, scratch, labels_out)
    take_next(next_tile)  # an atomic operation: all that went past the cache is there before anybody reads it
