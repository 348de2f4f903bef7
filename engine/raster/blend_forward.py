"""Front-to-back blending, plain Numba: the readable twin."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..machine.compiled import Array, parallel_kernel, part
from .conventions import ALPHA_MIN, TRANSMITTANCE_END
from .footprint import ALPHA_CAP, F, add_products, alpha_row, whiten_rows
from .records import BLUE, CHUNK, DEPTH, GREEN, L11, OPACITY, RECORD, RED, TILE

ONE = F(1.0)
ALPHA_LEAST = F(ALPHA_MIN)
ENDED = F(TRANSMITTANCE_END)


@part
def start_tile(width: int, height: int, left: int, top: int, through: Array, last: Array) -> None:
    """Transmittance one inside the image, minus one (ended) outside; nothing blended yet."""
    for r in range(TILE):
        for x in range(TILE):
            inside = left + x < width and top + r < height
            through[r, x] = ONE if inside else -ONE
            last[r, x] = -1


@part
def blend_row(alpha: Array, through: Array, weight: Array) -> None:
    """Weights [16] of one Gaussian on one row. The transmittance of an ended pixel is kept negative."""
    for x in range(TILE):
        capped = min(alpha[x], ALPHA_CAP)
        after = through[x] * (ONE - capped)
        seen = capped >= ALPHA_LEAST
        goes_on = after > ENDED
        weight[x] = capped * through[x] if seen and goes_on else F(0.0)
        ended = -abs(through[x]) if seen else through[x]
        through[x] = after if seen and goes_on else ended


@part
def add_colour_row(weight: Array, record: Array, planes: Array, row: int) -> None:
    for x in range(TILE):
        planes[0, row, x] += weight[x] * record[RED]
    for x in range(TILE):
        planes[1, row, x] += weight[x] * record[GREEN]
    for x in range(TILE):
        planes[2, row, x] += weight[x] * record[BLUE]
    for x in range(TILE):
        planes[3, row, x] += weight[x] * record[DEPTH]


@part
def add_label_rows(
    counts: Array,
    weights: Array,
    gaussians: Array,
    labels: Array,
    tile_labels: Array,
    by_pixel: Array,
    pixels: Array,
) -> None:
    """tile_labels [256, C] += the weights of a chunk's Gaussians times their labels, row after row."""
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
        add_products(
            tile_labels,
            pixels[r * TILE : (r + 1) * TILE],
            by_pixel,
            (TILE, padded),
            labels,
            gaussians[r],
            channels,
        )
        counts[r] = 0


@part
def any_alive(through: Array) -> Any:
    rows = 0
    for r in range(TILE):
        for x in range(TILE):
            if through[r, x] > F(0.0):
                rows |= 1 << r
                break
    return rows


@part
def write_tile(
    left: int,
    top: int,
    through: Array,
    last: Array,
    planes: Array,
    tile_labels: Array,
    image: Array,
    labels_out: Array,
    alpha: Array,
    depth: Array,
    rest: Array,
    last_out: Array,
) -> None:
    height, width = alpha.shape
    for r in range(min(TILE, height - top)):
        y = top + r
        for x in range(min(TILE, width - left)):
            image[y, left + x, 0] = planes[0, r, x]
            image[y, left + x, 1] = planes[1, r, x]
            image[y, left + x, 2] = planes[2, r, x]
            depth[y, left + x] = planes[3, r, x]
            rest[y, left + x] = abs(through[r, x])
            alpha[y, left + x] = ONE - abs(through[r, x])
            last_out[y, left + x] = last[r, x]
            for c in range(labels_out.shape[2]):
                labels_out[y, left + x, c] = tile_labels[r * TILE + x, c]


@parallel_kernel
def blend_tiles(
    worker: int,
    workers: int,
    next_tile: Array,
    starts: Array,
    tile_ids: Array,
    flat_records: Array,
    flat_labels: Array,
    channels: int,
    width: int,
    height: int,
    flat_image: Array,
    flat_labels_out: Array,
    flat_alpha: Array,
    flat_depth: Array,
    flat_rest: Array,
    flat_last: Array,
    scratches: Array,
    member_lists: Array,
    row_counts: Array,
) -> None:
    """Every ``workers``-th tile; arguments as those of its fast twin, which alone uses the last three."""
    records = flat_records.reshape(flat_records.size // RECORD, RECORD)
    labels = flat_labels.reshape(records.shape[0], channels)
    image = flat_image.reshape(height, width, 3)
    labels_out = flat_labels_out.reshape(height, width, channels)
    alpha = flat_alpha.reshape(height, width)
    depth = flat_depth.reshape(height, width)
    rest = flat_rest.reshape(height, width)
    last_out = flat_last.reshape(height, width)
    columns = (width + TILE - 1) // TILE
    s1_left = np.empty(TILE, np.float32)
    s2 = np.empty(TILE, np.float32)
    s1 = np.empty(TILE, np.float32)
    raw = np.empty(TILE, np.float32)
    bits = raw.view(np.int32)
    through = np.empty((TILE, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    planes = np.empty((4, TILE, TILE), np.float32)
    tile_labels = np.empty((TILE * TILE, channels), np.float32)
    counts = np.zeros(TILE, np.int64)
    weights = np.empty((TILE, CHUNK, TILE), np.float32)
    gaussians = np.empty((TILE, CHUNK), np.int32)
    by_pixel = np.empty((TILE, CHUNK), np.float32)
    pixels = np.arange(TILE * TILE)
    for tile in range(worker, starts.shape[0] - 1, workers):
        left = tile % columns * TILE
        top = tile // columns * TILE
        start_tile(width, height, left, top, through, last)
        planes[:] = F(0.0)
        tile_labels[:] = F(0.0)
        first = starts[tile]
        alive = any_alive(through)
        for chunk in range(first, starts[tile + 1], CHUNK):
            for k in range(chunk, min(chunk + CHUNK, starts[tile + 1])):
                record = records[tile_ids[k]]
                rows = whiten_rows(record, left, top, s1_left, s2) & alive
                for r in range(TILE):
                    if not (rows >> r) & 1:
                        continue
                    alpha_row(s1_left[r], record[L11], s2[r], record[OPACITY], s1, raw, bits)
                    weight = weights[r, counts[r]]
                    blend_row(raw, through[r], weight)
                    for x in range(TILE):
                        last[r, x] = np.int32(k - first) if weight[x] > F(0.0) else last[r, x]
                    add_colour_row(weight, record, planes, r)
                    gaussians[r, counts[r]] = tile_ids[k]
                    counts[r] += 1
            if channels > 0:
                add_label_rows(counts, weights, gaussians, labels, tile_labels, by_pixel, pixels)
            else:
                counts[:] = 0
            alive = any_alive(through)
            if alive == 0:
                break
        write_tile(left, top, through, last, planes, tile_labels, image, labels_out, alpha, depth, rest, last_out)
