"""Holds a batch of a tile's Gaussians (members), field by field, and finds which patches of the tile each one touches.

A patch is 8 x 2 pixels, and two patches side by side are a strip of the tile. A small Gaussian covers more of a patch
than of sixteen pixels in a row. In a vector, the pixels of a patch's two rows alternate. For each strip, sixteen
Gaussians are whitened at once (see `conventions`), which takes a few cycles each and no branch."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined, parallel_kernel
from ...machine.vector_shuffles import interleave2
from ...machine.vectors import broadcast, fma, get, load, maximum, movemask, prefetch, put, store
from .. import conventions
from ..arrays import GaussianGradients, IsectGradients, Shapes, Size, Tile
from ..conventions import BATCH, GRADIENT, GRADIENT_WIDTH, PATCH_HEIGHT, PATCH_WIDTH, RECORD, TILE
from ..isect_tiles import chunk_count, next_chunk
from ..projection import project_backward

F = np.float32
ZERO = F(0.0)
PATCHES = 2 * TILE // PATCH_HEIGHT
"""Patches of a tile. They are numbered strip by strip: patches 2 p and 2 p + 1 begin in row 2 p."""
LEFT_END, MIDDLE, RIGHT_END = F(PATCH_WIDTH - 1), F(PATCH_WIDTH), F(TILE - 1)
"""The last column of the left patches, the first and the last of the right ones."""
AHEAD = 8
"""A record is fetched this many Gaussians before it is needed, as records may be anywhere in memory."""
NEVER = F(-1e30)  # log2 of an opacity that shows on no pixel

# fields of a batch, as offsets in floats from its start; each has a slot for every member
ORIGIN_S1, ORIGIN_S2 = 0, BATCH  # s at the centre of the tile's first pixel
SLOPE, SHEAR, DROP = 2 * BATCH, 3 * BATCH, 4 * BATCH  # L11, L12, L22
LOG_OPACITIES = 5 * BATCH
REDS, GREENS, BLUES, DEPTHS = 6 * BATCH, 7 * BATCH, 8 * BATCH, 9 * BATCH
INDICES = 10 * BATCH  # in the tile's list
BATCH_FIELDS = 11 * BATCH + TILE  # the last one has a slot for PAD_INDEX too

# fields of one strip, as offsets in floats from their start; a pair for every member, one for each row
STRIP_S1 = 0  # s1 at the row's first pixel
STRIP_EXPONENTS = 2 * BATCH  # log2(opacity) - s2^2
PAD_INDEX = BATCH
"""Index used where there is no member. Its entry in STRIP_EXPONENTS makes it reach no pixel. Its other fields are read
too: they are the first member's next fields, which are finite numbers."""
STRIP_FIELDS = 4 * BATCH + TILE


@device_function
def origin_of(records: Array, at: int, tile: Tile) -> Any:
    """Return the whitened offset (s1, s2) of a tile's first pixel from the Gaussian with its record at records[at:]."""
    dx = tile.left + 0.5 - np.float64(get(records, at + conventions.CENTRE_X))
    dx -= np.float64(get(records, at + conventions.CENTRE_X_LOW))
    dy = tile.top + 0.5 - np.float64(get(records, at + conventions.CENTRE_Y))
    dy -= np.float64(get(records, at + conventions.CENTRE_Y_LOW))
    l11 = np.float64(get(records, at + conventions.L11)) + np.float64(get(records, at + conventions.L11_LOW))
    l12 = np.float64(get(records, at + conventions.L12)) + np.float64(get(records, at + conventions.L12_LOW))
    l22 = np.float64(get(records, at + conventions.L22)) + np.float64(get(records, at + conventions.L22_LOW))
    return F(l11 * dx + l12 * dy), F(l22 * dy)


@device_function
def load_batch(
    flatten_ids: Array, records: Array, tile: Tile, start: int, count: int, fields: Array, base: int
) -> None:
    """Copy the fields of ``count`` Gaussians, from index ``start`` of a tile's list on, to fields[base:]. The batch is
    filled up to a multiple of sixteen with members that reach no pixel."""
    first = tile.first + start
    for m in range(count):
        at = int(get(flatten_ids, first + m)) * RECORD
        prefetch(records, int(get(flatten_ids, first + min(m + AHEAD, count - 1))) * RECORD)
        s1, s2 = origin_of(records, at, tile)
        put(fields, base + ORIGIN_S1 + m, s1)
        put(fields, base + ORIGIN_S2 + m, s2)
        put(fields, base + LOG_OPACITIES + m, get(records, at + conventions.LOG_OPACITY))
        for c in range(3):  # L11, L12, L22
            put(fields, base + SLOPE + c * BATCH + m, get(records, at + conventions.L11 + c))
        for c in range(4):  # the colour and the depth
            put(fields, base + REDS + c * BATCH + m, get(records, at + conventions.RED + c))
        put(fields, base + INDICES + m, F(start + m))
    for m in range(count, (count + TILE - 1) // TILE * TILE):
        put(fields, base + LOG_OPACITIES + m, NEVER)


@inlined
def row_of(r: int, fields: Array, at: int) -> Any:
    """Return s1 at the first pixel of a tile's row ``r``, and s2^2, for the sixteen members with fields at ``at``."""
    row = broadcast(F(r))
    s1 = fma(load(fields, at + SHEAR), row, load(fields, at + ORIGIN_S1))
    s2 = fma(load(fields, at + DROP), row, load(fields, at + ORIGIN_S2))
    return s1, s2 * s2


@inlined
def touched(first: Any, last: Any, square: Any, reach: Any) -> Any:
    """Whether |s|^2 <= ``reach`` at a pixel of a part of a row: s1 from ``first`` to ``last``, ``square`` = s2^2."""
    nearest = maximum(maximum(first, broadcast(ZERO) - last), broadcast(ZERO))  # least |s1|: s1 grows along a row
    return fma(nearest, nearest, square) <= reach


@inlined
def halves_touched(s1: Any, slope: Any, square: Any, reach: Any) -> Any:
    """Return two bit masks of the sixteen Gaussians: which reach a row's left half, and which reach its right half."""
    left = touched(s1, fma(slope, broadcast(LEFT_END), s1), square, reach)
    right = touched(fma(slope, broadcast(MIDDLE), s1), fma(slope, broadcast(RIGHT_END), s1), square, reach)
    return movemask(left), movemask(right)


@device_function
def whiten_strip(r: int, count: int, fields: Array, base: int, strip: int) -> Any:
    """Compute the batch's whitened coordinates on the strip that begins in row ``r``, into the fields at ``strip``.
    Return two bit masks, of the members that touch its left and its right patch."""
    on_left, on_right = 0, 0
    for m in range(0, count, TILE):
        at = base + m
        slope, log_opacity = load(fields, at + SLOPE), load(fields, at + LOG_OPACITIES)
        reach = log_opacity + broadcast(conventions.REACH_OVER_LOG_OPACITY)
        upper, upper_square = row_of(r, fields, at)
        lower, lower_square = row_of(r + 1, fields, at)
        upper_left, upper_right = halves_touched(upper, slope, upper_square, reach)
        lower_left, lower_right = halves_touched(lower, slope, lower_square, reach)
        on_left |= (upper_left | lower_left) << m
        on_right |= (upper_right | lower_right) << m
        first, second = interleave2(upper, lower)
        store(fields, strip + STRIP_S1 + 2 * m, first)
        store(fields, strip + STRIP_S1 + 2 * m + TILE, second)
        first, second = interleave2(log_opacity - upper_square, log_opacity - lower_square)
        store(fields, strip + STRIP_EXPONENTS + 2 * m, first)
        store(fields, strip + STRIP_EXPONENTS + 2 * m + TILE, second)
    put(fields, strip + STRIP_EXPONENTS + 2 * PAD_INDEX, NEVER)
    put(fields, strip + STRIP_EXPONENTS + 2 * PAD_INDEX + 1, NEVER)
    return on_left, on_right


# Gradients of a Gaussian's intersections, which are added in order and carried back to its 3D parameters.


@parallel_kernel
def list_channels(worker: int, workers: int, d_labels: Array, size: Size, counts: Array, channels: Array) -> None:
    """Fill the arrays of ``TileChannels`` for every ``workers``-th tile. ``d_labels`` [P * C]: gradients, as int32."""
    columns, all_channels = (size.width + TILE - 1) // TILE, size.channels
    bits = np.empty(all_channels, np.int32)
    for tile in range(worker, counts.shape[0], workers):
        left, top, found = tile % columns * TILE, tile // columns * TILE, 0
        bits[:] = 0
        for row in range(top, min(top + TILE, size.height)):
            for column in range(left, min(left + TILE, size.width)):
                at = (row * size.width + column) * all_channels
                for c in range(all_channels):
                    bits[c] |= d_labels[at + c]
        for c in range(all_channels):
            if bits[c] != 0:
                channels[tile * all_channels + found] = c
                found += 1
        counts[tile] = found


@device_function
def clear(i: int, out: GaussianGradients) -> None:
    """Set the gradients of Gaussian i to 0, except those of its labels."""
    out.opacities[i] = F(0.0)
    for c in range(2):
        out.means2d[i, c] = F(0.0)
    for c in range(3):
        out.means[i, c] = F(0.0)
        out.scales[i, c] = F(0.0)
        out.colours[i, c] = F(0.0)
    for c in range(4):
        out.quats[i, c] = F(0.0)


@device_function
def gather_geometry(
    chunk: tuple[int, int], offsets: Array, isects: IsectGradients, scene: tuple[Shapes, Array, Array],
    out: GaussianGradients, total: Array,
) -> None:  # fmt: skip
    """Sum the gradients of each Gaussian of a chunk (first, last + 1) over its tiles, and write them to ``out``, except
    those of labels. ``scene``: shapes, records and camera; ``total`` float64 [GRADIENT]: working memory."""
    shapes, records, camera = scene
    tiles, values = isects.tiles, isects.values
    for i in range(chunk[0], chunk[1]):
        hit = False
        for c in range(GRADIENT):
            total[c] = 0.0
        for isect in range(offsets[i], offsets[i + 1]):
            if tiles[isect] < 0:
                continue
            for c in range(GRADIENT):
                total[c] += np.float64(values[isect * GRADIENT_WIDTH + c])
            hit = True
        if not hit:
            clear(i, out)
            continue
        # d(ln alpha) / d(opacity) is 1 / opacity
        out.opacities[i] = total[conventions.G] / np.float64(records[i, conventions.OPACITY])
        for c in range(3):
            out.colours[i, c] = total[conventions.D_RED + c]
        project_backward(i, total, records[i], shapes, camera, out)


@device_function
def gather_labels(
    chunk: tuple[int, int], offsets: Array, isects: IsectGradients, channels: int, d_labels: Array
) -> None:
    """Sum the label gradients of each Gaussian of a chunk (first, last + 1) over its tiles, into d_labels [N * C]."""
    used, tiles, labels = isects.used, isects.tiles, isects.labels
    for i in range(chunk[0], chunk[1]):
        at = i * channels
        for c in range(at, at + channels):
            d_labels[c] = F(0.0)
        for isect in range(offsets[i], offsets[i + 1]):
            tile, source = tiles[isect], isect * used.padded
            if tile < 0:
                continue
            first, count = tile * channels, used.counts[tile]
            if count == channels:
                for c in range(channels):
                    d_labels[at + c] += labels[source + c]
            else:
                for c in range(count):
                    d_labels[at + used.channels[first + c]] += labels[source + c]


@parallel_kernel
def gather(
    worker: int, workers: int, offsets: Array, isects: IsectGradients, channels: int,
    scene: tuple[Shapes, Array, Array], out: GaussianGradients, next_one: Array,
) -> None:  # fmt: skip
    """Sum the gradients of all N Gaussians over their tiles; a worker takes one chunk after another, ``next_one`` int64
    [1]. ``offsets`` int64 [N + 1]: ``Intersections.gaussian_offsets``. ``scene``: shapes, records [N, RECORD] and
    camera of the forward pass. Labels in ``out`` are [N * ``channels``]."""
    count, total = offsets.shape[0] - 1, np.empty(GRADIENT, np.float64)
    chunks = chunk_count(count)
    first, end = next_chunk(next_one, chunks, count)
    while first < end:
        gather_geometry((first, end), offsets, isects, scene, out, total)
        gather_labels((first, end), offsets, isects, channels, out.labels)
        first, end = next_chunk(next_one, chunks, count)
