"""Front-to-back blending, a patch of sixteen pixels at a time.

A patch takes all members of a batch one after another, with its state in registers, and lists those that it sees with
their weights; the labels of a whole list are added up at once, also in registers. Two patches side by side make a strip
of a tile, which is written row by row.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined, parallel_kernel
from ...machine.intrinsics import fetch_add
from ...machine.vector_functions import exp2_x4
from ...machine.vectors import (
    broadcast,
    broadcast_load,
    fma,
    fnmadd,
    load,
    load_pairs,
    maximum,
    minimum,
    movemask,
    put,
    select,
    store,
    trailing_zeros,
)
from ..arrays import Blended, Intersections, Scratch, Size, Splats, Tile
from ..conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from ..records import BATCH, PATCH_HEIGHT, PENDING, TILE, padded_channels
from .batch import (
    BATCH_FIELDS,
    BLUES,
    DEPTHS,
    GREENS,
    PAD_INDEX,
    PLACES,
    REDS,
    SLOPE,
    STRIP_EXPONENTS,
    STRIP_S1,
    load_batch,
    whiten_strip,
)
from .forward_strip import (
    COLUMNS,
    FINAL,
    LAST,
    LISTED,
    PATCH_STRIDE,
    PLANES,
    STATE,
    STRIP,
    STRIP_LABELS,
    TRANSMITTANCE,
    WEIGHTS,
    ZERO,
    F,
    start_strip,
    strip_floats,
    write_strip,
)
from .labels import add_listed_labels, load_labels, write_labels

ALPHA_CAP = F(ALPHA_MAX)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)
NEARLY_NOTHING = F(1e-20)
"""A transmittance is not multiplied below this, as subnormal numbers are slow."""


@device_function
def batch_floats(channels: int) -> int:
    return BATCH_FIELDS + BATCH * padded_channels(channels)


def scratch_size(channels: int, longest: int) -> int:
    """The floats of scratch that a worker needs if the longest list of a tile has ``longest`` Gaussians."""
    floats: int = STRIP_LABELS + strip_floats(channels) + -(-longest // BATCH) * batch_floats(channels)
    return floats


@inlined
def exponent_of(m: int, columns: Any, scratch: Array, fields: int) -> Any:
    """log2 of a member's alpha on the patch."""
    s1 = fma(broadcast_load(scratch, fields + SLOPE + m), columns, load_pairs(scratch, STRIP + STRIP_S1 + 2 * m))
    return fnmadd(s1, s1, load_pairs(scratch, STRIP + STRIP_EXPONENTS + 2 * m))


@inlined
def seen_alpha(raw: Any) -> Any:
    """The effective alpha: at most 0.99, and 0 if it is too small."""
    return select(raw >= broadcast(ALPHA_LEAST), minimum(raw, broadcast(ALPHA_CAP)), broadcast(ZERO))


@inlined
def blend_member(
    m: int, alpha: Any, state: Any, end: int, scratch: Array, fields: int, members: Array, labels: Any
) -> Any:
    """Blend one member. Returns the patch's new state, and the new end of the list of those blended.

    A pixel has ended once its transmittance is too small; the product continues, so it stays so for all that follow.
    """
    transmittance, final, last, red, green, blue, depth = state
    after = fnmadd(alpha, transmittance, transmittance)
    blended = (alpha > broadcast(ZERO)) & (after > broadcast(ENDED))
    weight = select(blended, alpha * transmittance, broadcast(ZERO))
    final = select(blended, after, final)
    last = select(blended, broadcast_load(scratch, fields + PLACES + m), last)
    red = fma(weight, broadcast_load(scratch, fields + REDS + m), red)
    green = fma(weight, broadcast_load(scratch, fields + GREENS + m), green)
    blue = fma(weight, broadcast_load(scratch, fields + BLUES + m), blue)
    depth = fma(weight, broadcast_load(scratch, fields + DEPTHS + m), depth)
    # If nothing was blended, the next member overwrites it. This is cheaper than a branch that cannot be predicted.
    first, vectors = labels
    store(scratch, WEIGHTS + end * TILE, weight)
    put(members, end, np.int32(first + m * vectors))
    return (after, final, last, red, green, blue, depth), end + int(movemask(blended) != 0)


@inlined
def take_four(mask: int, missing: int) -> Any:
    """The places of the four lowest bits of a mask (``missing`` if it has fewer), and the mask without them."""
    first = trailing_zeros(mask)
    mask &= mask - 1
    second = min(trailing_zeros(mask), missing)
    mask &= mask - 1
    third = min(trailing_zeros(mask), missing)
    mask &= mask - 1
    fourth = min(trailing_zeros(mask), missing)
    mask &= mask - 1
    return (first, second, third, fourth), mask


@inlined
def alphas_of(four: Any, columns: Any, scratch: Array, fields: int) -> Any:
    """The effective alphas of four members, side by side."""
    m0, m1, m2, m3 = four
    e0, e1 = exponent_of(m0, columns, scratch, fields), exponent_of(m1, columns, scratch, fields)
    e2, e3 = exponent_of(m2, columns, scratch, fields), exponent_of(m3, columns, scratch, fields)
    raw0, raw1, raw2, raw3 = exp2_x4(e0, e1, e2, e3)
    return seen_alpha(raw0), seen_alpha(raw1), seen_alpha(raw2), seen_alpha(raw3)


@inlined
def blend_four(
    four: Any, alphas: Any, state: Any, end: int, scratch: Array, fields: int, members: Array, labels: Any
) -> Any:
    """Blend four members in turn, like ``blend_member``. Returns also whether the patch still sees anything."""
    m0, m1, m2, m3 = four
    alpha0, alpha1, alpha2, alpha3 = alphas
    state, end = blend_member(m0, alpha0, state, end, scratch, fields, members, labels)
    state, end = blend_member(m1, alpha1, state, end, scratch, fields, members, labels)
    state, end = blend_member(m2, alpha2, state, end, scratch, fields, members, labels)
    state, end = blend_member(m3, alpha3, state, end, scratch, fields, members, labels)
    transmittance, final, last, red, green, blue, depth = state
    sees = movemask(transmittance > broadcast(ENDED)) != 0
    return (maximum(transmittance, broadcast(NEARLY_NOTHING)), final, last, red, green, blue, depth), end, sees


@device_function
def blend_patch(
    touching: int, at: int, scratch: Array, fields: int, members: Array, end: int, labels: tuple[int, int]
) -> Any:
    """Blend the members of a mask on the patch whose state is at scratch[at:], four at a time, so that none waits for
    another's alpha.

    Those that are blended anywhere are added, in order, to the list that ends before ``end``: their weights and, in
    ``members``, the places of their labels, for which ``labels`` gives the first member's place and the length in
    vectors. Returns the list's new end, and whether the patch still sees anything.
    """
    columns = load(scratch, at + COLUMNS)
    state = (
        load(scratch, at + TRANSMITTANCE),
        load(scratch, at + FINAL),
        load(scratch, at + LAST),
        load(scratch, at + PLANES),
        load(scratch, at + PLANES + TILE),
        load(scratch, at + PLANES + 2 * TILE),
        load(scratch, at + PLANES + 3 * TILE),
    )
    sees = movemask(state[0] > broadcast(ENDED)) != 0
    if sees and touching != 0:
        four, touching = take_four(touching, PAD_INDEX)
        alphas = alphas_of(four, columns, scratch, fields)
        while sees and touching != 0:
            # the next four's alphas are computed during the blending of these: neither waits for the other
            next_four, touching = take_four(touching, PAD_INDEX)
            next_alphas = alphas_of(next_four, columns, scratch, fields)
            state, end, sees = blend_four(four, alphas, state, end, scratch, fields, members, labels)
            four, alphas = next_four, next_alphas
        if sees:
            state, end, sees = blend_four(four, alphas, state, end, scratch, fields, members, labels)
    transmittance, final, last, red, green, blue, depth = state
    store(scratch, at + TRANSMITTANCE, transmittance)
    store(scratch, at + FINAL, final)
    store(scratch, at + LAST, last)
    store(scratch, at + PLANES, red)
    store(scratch, at + PLANES + TILE, green)
    store(scratch, at + PLANES + 2 * TILE, blue)
    store(scratch, at + PLANES + 3 * TILE, depth)
    return end, sees


@parallel_kernel
def blend_forward(
    worker: int, workers: int, isects: Intersections, splats: Splats, out: Blended, size: Size, scratches: Scratch
) -> None:
    """Process one tile after another until none is left."""
    scratch, members = scratches.floats[worker], scratches.members[worker]
    starts, flatten_ids, records, labels = isects.isect_offsets, isects.flatten_ids, splats.records, splats.labels
    width, height, channels = size.width, size.height, size.channels
    columns, tiles = (width + TILE - 1) // TILE, starts.shape[0] - 1
    padded = padded_channels(channels)
    batches = STRIP_LABELS + strip_floats(channels)
    while True:
        number = fetch_add(scratches.next_one)
        if number >= tiles:
            break
        left, top = number % columns * TILE, number // columns * TILE
        tile = Tile(left, top, starts[number], starts[number + 1] - starts[number])
        pixels = min(TILE, width - left)
        loaded = 0
        for r in range(0, min(TILE, height - top), PATCH_HEIGHT):
            rows = min(PATCH_HEIGHT, height - top - r)
            pixel = (top + r) * width + left
            start_strip(pixels, rows, channels, scratch)
            ends = (0, LISTED)
            for place in range(0, tile.length, BATCH):
                fields = batches + place // BATCH * batch_floats(channels)
                own_labels = fields + BATCH_FIELDS
                in_vectors = ((own_labels - batches) // TILE, padded // TILE)
                count = min(BATCH, tile.length - place)
                if place == loaded:
                    load_batch(flatten_ids, records, tile, place, count, scratch, fields)
                    if channels > 0:
                        load_labels(tile.first + place, count, flatten_ids, labels, channels, scratch, own_labels)
                    loaded += BATCH
                touching = whiten_strip(r, count, scratch, fields, STRIP)
                strip_sees = False
                for patch in range(2):
                    before, state = ends[patch], STATE + patch * PATCH_STRIDE
                    end, sees = blend_patch(touching[patch], state, scratch, fields, members, before, in_vectors)
                    strip_sees |= sees
                    if end > patch * LISTED + PENDING:
                        end = add_listed_labels(patch, end, scratch, members, batches, padded)
                    ends = (end, ends[1]) if patch == 0 else (ends[0], end)
                if not strip_sees:
                    break
            for patch in range(2):
                add_listed_labels(patch, ends[patch], scratch, members, batches, padded)
            write_strip(pixel, pixels, rows, width, scratch, out)
            if channels > 0:
                write_labels(pixel, pixels, rows, size, scratch, out.labels)
