"""Front-to-back blending, a patch of sixteen pixels at a time. The same steps as ``blend_forward``, its readable
twin.

A patch takes all members of a chunk one after the other, its state in registers, and lists those that it sees with
their weights; the labels of a whole list are added up at once, in registers too. Two patches side by side make a strip
of a tile, which is written row by row.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.atomics import take_next
from ...machine.compiled import Array, inlined, parallel_kernel, part
from ...machine.vector_functions import exp2_of_four
from ...machine.vectors import (
    bits_of,
    choose,
    everywhere,
    fma,
    less_product,
    load,
    lowest_bit,
    maximum,
    minimum,
    pairs,
    put,
    spread,
    store,
)
from ..conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from ..records import CHUNK, PATCH_HEIGHT, PATCH_WIDTH, PENDING, TILE, padded_channels
from .chunk import (
    BLUES,
    CHUNK_FIELDS,
    DEPTHS,
    GREENS,
    NOBODY,
    PLACES,
    REDS,
    SLOPE,
    STRIP_EXPONENTS,
    STRIP_S1,
    load_chunk,
    whiten_strip,
)
from .forward_strip import (
    COLUMNS,
    LAST,
    LISTED,
    PATCH_STRIDE,
    PLANES,
    REST,
    STATE,
    STRIP,
    STRIP_LABELS,
    THROUGH,
    WEIGHTS,
    ZERO,
    F,
    fetch_row,
    start_strip,
    strip_floats,
    write_strip,
)
from .labels import (
    FinishedStrip,
    Lines,
    add_patch_labels,
    copy_touching,
    fetch_labels,
    flush_all,
    flush_lines,
    pack_labels,
)

ALPHA_CAP = F(ALPHA_MAX)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)
NEARLY_NOTHING = F(1e-20)
"""A transmittance is not multiplied further down: subnormal numbers are slow."""


@part
def chunk_floats(channels: int) -> int:
    return CHUNK_FIELDS + CHUNK * padded_channels(channels)


def scratch_size(channels: int, longest: int) -> int:
    """Floats of scratch that a worker needs when the longest list of a tile has so many Gaussians."""
    floats: int = STRIP_LABELS + 2 * strip_floats(channels) + -(-longest // CHUNK) * chunk_floats(channels)
    return floats


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
def blend_member(
    m: int, alpha: Any, state: Any, end: int, scratch: Array, fields: int, members: Array, labels: Any
) -> Any:
    """Blend one member; returns the patch's new state, and the new end of the list of those blended.

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
    first, vectors = labels
    store(scratch, WEIGHTS + end * TILE, weight)
    put(members, end, np.int32(first + m * vectors))
    return (after, rest, last, red, green, blue, depth), end + int(bits_of(blended) != 0)


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
    four: Any, alphas: Any, state: Any, end: int, scratch: Array, fields: int, members: Array, labels: Any
) -> Any:
    """Blend four members, one after the other; as ``blend_member``, and whether the patch still sees anything."""
    m0, m1, m2, m3 = four
    alpha0, alpha1, alpha2, alpha3 = alphas
    state, end = blend_member(m0, alpha0, state, end, scratch, fields, members, labels)
    state, end = blend_member(m1, alpha1, state, end, scratch, fields, members, labels)
    state, end = blend_member(m2, alpha2, state, end, scratch, fields, members, labels)
    state, end = blend_member(m3, alpha3, state, end, scratch, fields, members, labels)
    through, rest, last, red, green, blue, depth = state
    sees = bits_of(through > spread(ENDED)) != 0
    return (maximum(through, spread(NEARLY_NOTHING)), rest, last, red, green, blue, depth), end, sees


@part
def blend_patch(
    touching: int, at: int, scratch: Array, fields: int, members: Array, end: int, labels: tuple[int, int]
) -> Any:
    """Blend the members of a mask on the patch whose state lies at scratch[at:], four at a time, so that one does not
    wait for the other's alpha.

    Those that are blended anywhere are added, in order, to the list that ends before ``end``: their weights, and in
    ``members`` where their labels lie, of which ``labels`` tells the first member's place and the length in vectors.
    Returns the list's new end, and whether the patch still sees anything.
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
    sees = bits_of(state[0] > spread(ENDED)) != 0
    if sees and touching != 0:
        four, touching = take_four(touching, NOBODY)
        alphas = alphas_of(four, columns, scratch, fields)
        while sees and touching != 0:
            # the next four's alphas beside the blending of these: neither waits for the other
            next_four, touching = take_four(touching, NOBODY)
            next_alphas = alphas_of(next_four, columns, scratch, fields)
            state, end, sees = blend_four(four, alphas, state, end, scratch, fields, members, labels)
            four, alphas = next_four, next_alphas
        if sees:
            state, end, sees = blend_four(four, alphas, state, end, scratch, fields, members, labels)
    through, rest, last, red, green, blue, depth = state
    store(scratch, at + THROUGH, through)
    store(scratch, at + REST, rest)
    store(scratch, at + LAST, last)
    store(scratch, at + PLANES, red)
    store(scratch, at + PLANES + TILE, green)
    store(scratch, at + PLANES + 2 * TILE, blue)
    store(scratch, at + PLANES + 3 * TILE, depth)
    return end, sees


@part
def add_listed_labels(
    patch: int,
    end: int,
    strip_labels: int,
    scratch: Array,
    members: Array,
    chunks: int,
    padded: int,
    lines: Lines,
    finished: FinishedStrip,
    labels_out: Array,
) -> Any:
    """Add up the labels of those that were blended on a patch, whose list ends before ``end``; returns the end of the
    empty list, and the lines of the strip before that are left."""
    listed = patch * LISTED
    labels, weights = strip_labels + patch * PATCH_WIDTH * padded, WEIGHTS + listed * TILE
    if padded > 0:
        lines = add_patch_labels(
            end - listed, labels, scratch, weights, members, listed, chunks, padded, lines, finished, labels_out
        )
    return listed, lines


@parallel_kernel
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
    layers = (image, alpha, depth, rest, last_out)
    columns = (width + TILE - 1) // TILE
    tiles = starts.shape[0] - 1
    padded = padded_channels(channels)
    chunks = STRIP_LABELS + 2 * strip_floats(channels)
    strip_labels = STRIP_LABELS
    # the labels of the strip before: they go to memory, a few lines at a time, while this one is computed
    row, padded_row = width * channels, TILE * padded
    lines, finished = (0, 0), (0, 0, padded_row, row)
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
                fetch_row(pixel + own * width, layers)
            start_strip(pixels, rows, strip_labels, channels, scratch)
            ends = (0, LISTED)
            for place in range(0, total, CHUNK):
                c = place // CHUNK
                fields = chunks + c * chunk_floats(channels)
                own_labels = fields + CHUNK_FIELDS
                in_vectors = ((own_labels - chunks) // TILE, padded // TILE)
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
                    before, state = ends[patch], STATE + patch * PATCH_STRIDE
                    end, sees = blend_patch(touching[patch], state, scratch, fields, members, before, in_vectors)
                    strip_sees |= sees
                    lines = flush_lines(lines, finished, scratch, labels_out)
                    if channels > 0 and end > before:
                        copy_touching(
                            touching[patch], first + place, tile_ids, labels, channels, scratch, own_labels, copied, c
                        )
                    if end > patch * LISTED + PENDING:
                        end, lines = add_listed_labels(
                            patch, end, strip_labels, scratch, members, chunks, padded, lines, finished, labels_out
                        )
                    ends = (end, ends[1]) if patch == 0 else (ends[0], end)
                if not strip_sees:
                    break
            for patch in range(2):
                _, lines = add_listed_labels(
                    patch, ends[patch], strip_labels, scratch, members, chunks, padded, lines, finished, labels_out
                )
            write_strip(pixel, pixels, rows, width, scratch, layers)
            flush_all(lines, finished, scratch, labels_out)
            if channels > 0:
                target = pixel * channels
                upper = pack_labels(target, pixels, channels, strip_labels, scratch, labels_out)
                lower = 0
                if rows > 1:
                    lower = pack_labels(target + row, pixels, channels, strip_labels + padded_row, scratch, labels_out)
                lines, finished = (upper, lower), (strip_labels, target, padded_row, row)
                strip_labels = 2 * STRIP_LABELS + strip_floats(channels) - strip_labels  # the other one
    flush_all(lines, finished, scratch, labels_out)
