"""Front-to-back blending, plain Numba: the readable twin."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ..arrays import Blended, Intersections, Scratch, Size, Splats, Tile
from ..conventions import ALPHA_MIN, TRANSMITTANCE_END
from ..records import BATCH, BLUE, DEPTH, GREEN, L11, OPACITY, RECORD, RED, TILE
from .footprint import ALPHA_CAP, F, add_product, alpha_row, whiten_rows

ONE = F(1.0)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)


@device_function
def start_tile(width: int, height: int, left: int, top: int, transmittance: Array, last: Array) -> None:
    """Transmittance one inside the image, minus one (ended) outside; nothing blended yet."""
    for r in range(TILE):
        for x in range(TILE):
            inside = left + x < width and top + r < height
            transmittance[r, x] = ONE if inside else -ONE
            last[r, x] = -1


@device_function
def blend_row(alpha: Array, transmittance: Array, weight: Array) -> None:
    """Weights [16] of one Gaussian on one row. The transmittance of an ended pixel is kept negative."""
    for x in range(TILE):
        capped = min(alpha[x], ALPHA_CAP)
        after = transmittance[x] * (ONE - capped)
        seen = capped >= ALPHA_LEAST
        goes_on = after > ENDED
        weight[x] = capped * transmittance[x] if seen and goes_on else F(0.0)
        ended = -abs(transmittance[x]) if seen else transmittance[x]
        transmittance[x] = after if seen and goes_on else ended


@device_function
def add_colour_row(weight: Array, record: Array, planes: Array, row: int) -> None:
    for x in range(TILE):
        planes[0, row, x] += weight[x] * record[RED]
    for x in range(TILE):
        planes[1, row, x] += weight[x] * record[GREEN]
    for x in range(TILE):
        planes[2, row, x] += weight[x] * record[BLUE]
    for x in range(TILE):
        planes[3, row, x] += weight[x] * record[DEPTH]


@device_function
def add_label_rows(
    counts: Array,
    weights: Array,
    gaussians: Array,
    labels: Array,
    tile_labels: Array,
    by_pixel: Array,
    pixels: Array,
) -> None:
    """tile_labels [256, C] += the weights of a batch's Gaussians times their labels, row after row."""
    channels = labels.shape[1]
    for r in range(TILE):
        used = counts[r]
        if used == 0:
            continue
        padded = (used + 3) // 4 * 4
        for k in range(used, padded):
            gaussians[r, k] = gaussians[r, 0]
            weights[r, k, :] = F(0.0)
        for k in range(padded):
            for x in range(TILE):
                by_pixel[x, k] = weights[r, k, x]
        add_product(
            tile_labels,
            pixels[r * TILE : (r + 1) * TILE],
            by_pixel,
            (TILE, padded),
            labels,
            gaussians[r],
            channels,
        )
        counts[r] = 0


@device_function
def any_alive(transmittance: Array) -> Any:
    rows = 0
    for r in range(TILE):
        for x in range(TILE):
            if transmittance[r, x] > F(0.0):
                rows |= 1 << r
                break
    return rows


class TileState(NamedTuple):
    """A tile while it is blended: ``transmittance`` float32 and ``last`` int32 [16, 16], ``planes`` float32
    [4, 16, 16] (red, green, blue, depth), ``labels`` float32 [256, C]."""

    transmittance: Array
    last: Array
    planes: Array
    labels: Array


@device_function
def write_tile(tile: Tile, state: TileState, out: Blended) -> None:
    """The tile's pixels; ``out`` shaped as a picture."""
    left, top, planes = tile.left, tile.top, state.planes
    height, width = out.alpha.shape
    for r in range(min(TILE, height - top)):
        y = top + r
        for x in range(min(TILE, width - left)):
            out.image[y, left + x, 0] = planes[0, r, x]
            out.image[y, left + x, 1] = planes[1, r, x]
            out.image[y, left + x, 2] = planes[2, r, x]
            out.depth[y, left + x] = planes[3, r, x]
            out.final[y, left + x] = abs(state.transmittance[r, x])
            out.alpha[y, left + x] = ONE - abs(state.transmittance[r, x])
            out.last[y, left + x] = state.last[r, x]
            for c in range(out.labels.shape[2]):
                out.labels[y, left + x, c] = state.labels[r * TILE + x, c]


@parallel_kernel
def blend_forward(
    worker: int, workers: int, isects: Intersections, splats: Splats, out: Blended, size: Size, scratches: Scratch
) -> None:
    """Every ``workers``-th tile; as its vector twin, which alone uses the scratch."""
    starts, flatten_ids = isects.isect_offsets, isects.flatten_ids
    records = splats.records.reshape(splats.records.size // RECORD, RECORD)
    width, height, channels = size.width, size.height, size.channels
    labels = splats.labels.reshape(records.shape[0], channels)
    picture = Blended(
        out.image.reshape(height, width, 3),
        out.labels.reshape(height, width, channels),
        out.alpha.reshape(height, width),
        out.depth.reshape(height, width),
        out.final.reshape(height, width),
        out.last.reshape(height, width),
    )
    columns = (width + TILE - 1) // TILE
    s1_left = np.empty(TILE, np.float32)
    s2 = np.empty(TILE, np.float32)
    s1 = np.empty(TILE, np.float32)
    raw = np.empty(TILE, np.float32)
    bits = raw.view(np.int32)
    transmittance = np.empty((TILE, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    planes = np.empty((4, TILE, TILE), np.float32)
    tile_labels = np.empty((TILE * TILE, channels), np.float32)
    state = TileState(transmittance, last, planes, tile_labels)
    counts = np.zeros(TILE, np.int64)
    weights = np.empty((TILE, BATCH, TILE), np.float32)
    gaussians = np.empty((TILE, BATCH), np.int32)
    by_pixel = np.empty((TILE, BATCH), np.float32)
    pixels = np.arange(TILE * TILE)
    for number in range(worker, starts.shape[0] - 1, workers):
        left, top = number % columns * TILE, number // columns * TILE
        first, end = starts[number], starts[number + 1]
        start_tile(width, height, left, top, transmittance, last)
        planes[:] = F(0.0)
        tile_labels[:] = F(0.0)
        alive = any_alive(transmittance)
        for batch in range(first, end, BATCH):
            for k in range(batch, min(batch + BATCH, end)):
                record = records[flatten_ids[k]]
                rows = whiten_rows(record, left, top, s1_left, s2) & alive
                for r in range(TILE):
                    if not (rows >> r) & 1:
                        continue
                    alpha_row(s1_left[r], record[L11], s2[r], record[OPACITY], s1, raw, bits)
                    weight = weights[r, counts[r]]
                    blend_row(raw, transmittance[r], weight)
                    for x in range(TILE):
                        last[r, x] = np.int32(k - first) if weight[x] > F(0.0) else last[r, x]
                    add_colour_row(weight, record, planes, r)
                    gaussians[r, counts[r]] = flatten_ids[k]
                    counts[r] += 1
            if channels > 0:
                add_label_rows(counts, weights, gaussians, labels, tile_labels, by_pixel, pixels)
            else:
                counts[:] = 0
            alive = any_alive(transmittance)
            if alive == 0:
                break
        write_tile(Tile(left, top, first, end - first), state, picture)
