"""The forward pass of the blending, front to back, a patch of 8 x 2 pixels at a time.

A patch takes the Gaussians of a batch (its members) in turn, keeps its state in registers, and lists those it blends,
with their weights; the labels of the whole list are then added up at once, also in registers. Two patches side by side
are a strip of the tile, which is written to the image row by row."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine import vectors as v
from ...machine.compiled import Array, device_function, inlined, parallel_kernel
from ...machine.matrix_product import Factors, ListedRows, Rows, add_product
from ...machine.vector_shuffles import deinterleave2, interleave2, interleave3
from ..arrays import Blended, Intersections, Scratch, Size, Splats, Tile
from ..conventions import ALPHA_MAX, ALPHA_MIN, BATCH, PATCH_HEIGHT, PENDING, TILE, TRANSMITTANCE_END, padded_channels
from . import batch

# A strip of a tile, two rows as two patches side by side: where a worker keeps it, and how the image gets it.

F = np.float32
ZERO, ONE = F(0.0), F(1.0)

# a worker's scratch, in floats
STRIP = 0  # the current strip's fields of its members
WEIGHTS = STRIP + batch.STRIP_FIELDS  # [patch, blended, pixel], with space for those that turn out not to be blended
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
    """Initialise a strip in the scratch: nothing blended; pixels beyond its ``columns`` and ``rows`` closed."""
    left, right = interleave2(v.lane_numbers(), v.lane_numbers())
    row, _ = interleave2(v.broadcast(ZERO), v.broadcast(ONE))
    in_rows = row < v.broadcast(F(rows))
    for state, column in ((STATE, left), (STATE + PATCH_STRIDE, right)):
        inside = (column < v.broadcast(F(columns))) & in_rows
        v.store(scratch, state + COLUMNS, column)
        v.store(scratch, state + TRANSMITTANCE, v.select(inside, v.broadcast(ONE), v.broadcast(ZERO)))
        v.store(scratch, state + FINAL, v.broadcast(ONE))
        v.store(scratch, state + LAST, v.broadcast(-ONE))
        for plane in range(4):
            v.store(scratch, state + PLANES + plane * TILE, v.broadcast(ZERO))
    for at in range(STRIP_LABELS, STRIP_LABELS + strip_floats(channels), TILE):
        v.store(scratch, at, v.broadcast(ZERO))


@inlined
def rows_of(field: int, scratch: Array) -> Any:
    """Return a ``field`` (an offset in STATE) of the strip's pixels as two vectors: the upper and the lower row."""
    return deinterleave2(v.load(scratch, STATE + field), v.load(scratch, STATE + PATCH_STRIDE + field))


@device_function
def write_strip(pixel: int, columns: int, rows: int, width: int, scratch: Array, out: Blended) -> None:
    """Write ``rows`` x ``columns`` of a strip, except labels, to ``out`` from ``pixel`` on. ``width``: the image's."""
    final, last, red = rows_of(FINAL, scratch), rows_of(LAST, scratch), rows_of(PLANES, scratch)
    green, blue = rows_of(PLANES + TILE, scratch), rows_of(PLANES + 2 * TILE, scratch)
    depth = rows_of(PLANES + 3 * TILE, scratch)
    write_row(pixel, columns, (final[0], last[0], red[0], green[0], blue[0], depth[0]), out)
    if rows > 1:
        write_row(pixel + width, columns, (final[1], last[1], red[1], green[1], blue[1], depth[1]), out)


@inlined
def write_row(pixel: int, columns: int, state: Any, out: Blended) -> None:
    """Write ``columns`` pixels of a row to ``out`` at ``pixel``. ``state``: final, last, red, green, blue, depth."""
    final, last, red, green, blue, own_depth = state
    inside = v.lane_numbers() < v.broadcast(F(columns))
    v.masked_store(out.final, pixel, final, inside)
    v.masked_store(out.alpha, pixel, v.broadcast(ONE) - final, inside)
    v.masked_store(out.depth, pixel, own_depth, inside)
    v.masked_store(out.last, pixel, last, inside)
    write_colours(3 * pixel, 3 * columns, interleave3(red, green, blue), out.image)


@inlined
def write_colours(target: int, floats: int, colours: Any, image: Array) -> None:
    """Interleave a row's red, green and blue vectors, and write them to image[target : target + floats]."""
    first, second, third = colours
    v.masked_store(image, target, first, v.lane_numbers() < v.broadcast(F(floats)))
    v.masked_store(image, target + TILE, second, v.lane_numbers() < v.broadcast(F(floats - TILE)))
    v.masked_store(image, target + 2 * TILE, third, v.lane_numbers() < v.broadcast(F(floats - 2 * TILE)))


# The labels of a strip.
#
# The labels of its Gaussians are copied side by side, batch by batch, and added up by their weights on each patch.


@device_function
def copy_labels(gaussian: int, labels: Array, channels: int, scratch: Array, at: int) -> None:
    """Copy one Gaussian's labels to scratch[at:], padded with zeros to whole vectors."""
    source = gaussian * channels
    for c in range(0, channels - TILE + 1, TILE):
        v.store(scratch, at + c, v.load(labels, source + c))
    rest = channels % TILE
    if rest > 0:
        c = channels - rest
        v.store(scratch, at + c, v.masked_load(labels, source + c, v.lane_numbers() < v.broadcast(F(rest))))


@device_function
def load_labels(
    first: int, count: int, flatten_ids: Array, labels: Array, channels: int, scratch: Array, at: int
) -> None:
    """Copy the ``channels`` labels of ``count`` Gaussians flatten_ids[first:], padded to vectors, to scratch[at:]."""
    for m in range(count):
        ahead = int(v.get(flatten_ids, first + min(m + batch.AHEAD, count - 1))) * channels
        for c in range(0, channels, TILE):
            v.prefetch(labels, ahead + c)
        copy_labels(int(v.get(flatten_ids, first + m)), labels, channels, scratch, at + m * padded_channels(channels))


@device_function
def add_listed_labels(patch: int, end: int, scratch: Array, members: Array, batches: int, padded: int) -> int:
    """Add weight * label to a patch's pixels for each Gaussian in the patch's list, which ends before ``end``, and
    empty the list: return its new end. ``members`` says where each Gaussian's labels begin, in vectors from
    scratch[batches:]."""
    listed = patch * LISTED
    out = Rows(scratch, STRIP_LABELS + patch * TILE * padded, padded)
    weights = Factors(scratch, WEIGHTS + listed * TILE, 1, TILE)
    add_product(out, weights, ListedRows(scratch, batches, TILE, members, listed), TILE, padded, end - listed)
    return listed


@device_function
def write_labels(pixel: int, columns: int, rows: int, size: Size, scratch: Array, labels_out: Array) -> None:
    """Write the labels of a strip's pixels inside the image, without padding, to ``labels_out`` [P * C]. The strip's
    first pixel has index ``pixel``."""
    channels, padded = size.channels, padded_channels(size.channels)
    in_tail = v.lane_numbers() < v.broadcast(F(channels - padded + TILE))
    for y in range(rows):
        for x in range(columns):
            source = STRIP_LABELS + (PATCH_HEIGHT * x + y) * padded
            target = (pixel + y * size.width + x) * channels
            for c in range(0, padded - TILE, TILE):
                v.store(labels_out, target + c, v.load(scratch, source + c))
            v.masked_store(labels_out, target + padded - TILE, v.load(scratch, source + padded - TILE), in_tail)


ALPHA_CAP = F(ALPHA_MAX)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)
NEARLY_NOTHING = F(1e-20)
"""Transmittances stop shrinking below this, as subnormal numbers are slow."""


@device_function
def batch_floats(channels: int) -> int:
    return batch.BATCH_FIELDS + BATCH * padded_channels(channels)


def scratch_size(channels: int, longest: int) -> int:
    """Return how many floats of scratch a worker needs, if tiles have at most ``longest`` Gaussians."""
    floats: int = STRIP_LABELS + strip_floats(channels) + -(-longest // BATCH) * batch_floats(channels)
    return floats


@inlined
def exponent_of(m: int, columns: Any, scratch: Array, fields: int) -> Any:
    """Return log2 of the alpha of member ``m`` of the batch (its fields at scratch[fields:]) at the sixteen pixels of a
    patch, which are in these ``columns``."""
    first = v.load_pairs(scratch, STRIP + batch.STRIP_S1 + 2 * m)
    s1 = v.fma(v.broadcast_load(scratch, fields + batch.SLOPE + m), columns, first)
    return v.fnmadd(s1, s1, v.load_pairs(scratch, STRIP + batch.STRIP_EXPONENTS + 2 * m))


@inlined
def seen_alpha(raw: Any) -> Any:
    """Return ``raw`` alpha as it is blended: at most 0.99, and 0 if below 1/255."""
    return v.select(raw >= v.broadcast(ALPHA_LEAST), v.minimum(raw, v.broadcast(ALPHA_CAP)), v.broadcast(ZERO))


@inlined
def blend_member(
    m: int, alpha: Any, state: Any, end: int, scratch: Array, fields: int, members: Array, labels: Any
) -> Any:
    """Blend member ``m`` of the batch on a patch, given its ``alpha`` at the pixels. Return the patch's new ``state``,
    and the ``end`` of its list of blended ones. A pixel with too little transmittance is closed, and stays so."""
    transmittance, final, last, red, green, blue, depth = state
    after = v.fnmadd(alpha, transmittance, transmittance)
    blended = (alpha > v.broadcast(ZERO)) & (after > v.broadcast(ENDED))
    weight = v.select(blended, alpha * transmittance, v.broadcast(ZERO))
    final = v.select(blended, after, final)
    last = v.select(blended, v.broadcast_load(scratch, fields + batch.INDICES + m), last)
    red = v.fma(weight, v.broadcast_load(scratch, fields + batch.REDS + m), red)
    green = v.fma(weight, v.broadcast_load(scratch, fields + batch.GREENS + m), green)
    blue = v.fma(weight, v.broadcast_load(scratch, fields + batch.BLUES + m), blue)
    depth = v.fma(weight, v.broadcast_load(scratch, fields + batch.DEPTHS + m), depth)
    # If nothing was blended, the next member overwrites it. This is cheaper than a branch that cannot be predicted.
    first, vectors = labels
    v.store(scratch, WEIGHTS + end * TILE, weight)
    v.put(members, end, np.int32(first + m * vectors))
    return (after, final, last, red, green, blue, depth), end + int(v.movemask(blended) != 0)


@inlined
def take_four(mask: int, missing: int) -> Any:
    """Return the indices of ``mask``'s four lowest set bits (``missing`` for fewer), and the mask without them."""
    first = v.trailing_zeros(mask)  # callers have at least one bit
    mask &= mask - 1
    second = min(v.trailing_zeros(mask), missing)  # an empty mask has 64 zeros
    mask &= mask - 1
    third = min(v.trailing_zeros(mask), missing)
    mask &= mask - 1
    fourth = min(v.trailing_zeros(mask), missing)
    mask &= mask - 1
    return (first, second, third, fourth), mask


@inlined
def alphas_of(four: Any, columns: Any, scratch: Array, fields: int) -> Any:
    """Return the alphas, as blended, of ``four`` members at a patch's pixels; arguments are as in `exponent_of`."""
    m0, m1, m2, m3 = four
    e0, e1 = exponent_of(m0, columns, scratch, fields), exponent_of(m1, columns, scratch, fields)
    e2, e3 = exponent_of(m2, columns, scratch, fields), exponent_of(m3, columns, scratch, fields)
    raw0, raw1, raw2, raw3 = v.exp2_x4(e0, e1, e2, e3)
    return seen_alpha(raw0), seen_alpha(raw1), seen_alpha(raw2), seen_alpha(raw3)


@inlined
def blend_four(
    four: Any, alphas: Any, state: Any, end: int, scratch: Array, fields: int, members: Array, labels: Any
) -> Any:
    """Blend ``four`` members as ``blend_member`` does one. Return state, list end, and whether any pixel is open."""
    m0, m1, m2, m3 = four
    alpha0, alpha1, alpha2, alpha3 = alphas
    state, end = blend_member(m0, alpha0, state, end, scratch, fields, members, labels)
    state, end = blend_member(m1, alpha1, state, end, scratch, fields, members, labels)
    state, end = blend_member(m2, alpha2, state, end, scratch, fields, members, labels)
    state, end = blend_member(m3, alpha3, state, end, scratch, fields, members, labels)
    transmittance, final, last, red, green, blue, depth = state
    sees = v.movemask(transmittance > v.broadcast(ENDED)) != 0
    return (v.maximum(transmittance, v.broadcast(NEARLY_NOTHING)), final, last, red, green, blue, depth), end, sees


@device_function
def blend_patch(
    touching: int, at: int, scratch: Array, fields: int, members: Array, end: int, labels: tuple[int, int]
) -> Any:
    """Blend the Gaussians of a batch that touch a patch, as the bit mask ``touching`` says. The patch's state is at
    scratch[at:], the batch's fields at scratch[fields:]. Gaussians that show on a pixel are appended to the patch's
    list at ``end``, which is used for labels: weights go to the scratch, offsets of their labels to ``members``.
    ``labels``: where the first Gaussian's labels begin, and how long each Gaussian's are, in vectors. Return the list's
    new end, and whether any pixel is still open."""
    columns = v.load(scratch, at + COLUMNS)
    state = (
        v.load(scratch, at + TRANSMITTANCE),
        v.load(scratch, at + FINAL),
        v.load(scratch, at + LAST),
        v.load(scratch, at + PLANES),
        v.load(scratch, at + PLANES + TILE),
        v.load(scratch, at + PLANES + 2 * TILE),
        v.load(scratch, at + PLANES + 3 * TILE),
    )
    sees = v.movemask(state[0] > v.broadcast(ENDED)) != 0
    if sees and touching != 0:
        four, touching = take_four(touching, batch.PAD_INDEX)
        alphas = alphas_of(four, columns, scratch, fields)
        while sees and touching != 0:
            # the next four's alphas are computed during the blending of these: neither waits for the other
            next_four, touching = take_four(touching, batch.PAD_INDEX)
            next_alphas = alphas_of(next_four, columns, scratch, fields)
            state, end, sees = blend_four(four, alphas, state, end, scratch, fields, members, labels)
            four, alphas = next_four, next_alphas
        if sees:
            state, end, sees = blend_four(four, alphas, state, end, scratch, fields, members, labels)
    transmittance, final, last, red, green, blue, depth = state
    v.store(scratch, at + TRANSMITTANCE, transmittance)
    v.store(scratch, at + FINAL, final)
    v.store(scratch, at + LAST, last)
    v.store(scratch, at + PLANES, red)
    v.store(scratch, at + PLANES + TILE, green)
    v.store(scratch, at + PLANES + 2 * TILE, blue)
    v.store(scratch, at + PLANES + 3 * TILE, depth)
    return end, sees


@parallel_kernel
def blend_forward(
    worker: int, workers: int, isects: Intersections, splats: Splats, out: Blended, size: Size, scratches: Scratch
) -> None:
    """Blend all pixels into ``out``. Each worker takes one tile after another until none is left."""
    scratch, members = scratches.floats[worker], scratches.members[worker]
    starts, flatten_ids, records, labels = isects.isect_offsets, isects.flatten_ids, splats.records, splats.labels
    width, height, channels = size.width, size.height, size.channels
    columns, tiles = (width + TILE - 1) // TILE, starts.shape[0] - 1
    padded = padded_channels(channels)
    batches = STRIP_LABELS + strip_floats(channels)
    while True:
        number = v.fetch_add(scratches.next_one)
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
            ends = (0, LISTED)  # each patch has a part of the lists to itself
            for start in range(0, tile.length, BATCH):
                fields = batches + start // BATCH * batch_floats(channels)
                own_labels = fields + batch.BATCH_FIELDS
                in_vectors = ((own_labels - batches) // TILE, padded // TILE)
                count = min(BATCH, tile.length - start)
                if start == loaded:  # by the first strip that gets this far, for all below it
                    batch.load_batch(flatten_ids, records, tile, start, count, scratch, fields)
                    if channels > 0:
                        load_labels(tile.first + start, count, flatten_ids, labels, channels, scratch, own_labels)
                    loaded += BATCH
                touching = batch.whiten_strip(r, count, scratch, fields, STRIP)
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
