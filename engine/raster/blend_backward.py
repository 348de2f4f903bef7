"""Back-to-front gradients of the blending, plain Numba: the readable twin.

Walking back, T_i = T_{i+1} / (1 - alpha_i) and one running sum per pixel is all that is needed:
with v_i = colour_i . dL/dimage + z_i * dL/ddepth and S_i = sum_{j>i} w_j v_j - T_end * dL/dalpha,
dL/dalpha_i = T_i v_i - S_i / (1 - alpha_i). (Carrying the alpha output as a final term keeps it exact where
T_end is tiny.) Each Gaussian's gradient in each tile goes to a place of its own; a later pass adds them in
order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..machine.compiled import Array, contracted_part, parallel_kernel, part
from .blend_forward import ALPHA_LEAST, ONE
from .footprint import ALPHA_CAP, F, add_products, alpha_row, whiten_rows
from .records import (
    BLUE,
    CHUNK,
    D_BLUE,
    DEPTH,
    GRADIENT,
    GRADIENT_WIDTH,
    GREEN,
    L11,
    OPACITY,
    RECORD,
    RED,
    TILE,
    padded_channels,
)

ZERO = F(0.0)


@part
def load_tile(
    left: int,
    top: int,
    rest: Array,
    last_in: Array,
    d_image: Array,
    d_alpha: Array,
    d_depth: Array,
    through: Array,
    behind: Array,
    last: Array,
    d_planes: Array,
    last_of_row: Array,
) -> Any:
    """The tile's state at its far end; zeros outside the image. Returns the largest place blended in the
    tile."""
    height, width = rest.shape
    far = -1
    for r in range(TILE):
        last_of_row[r] = -1
        for x in range(TILE):
            last[r, x] = -1
            through[r, x] = ONE
            behind[r, x] = ZERO
            for c in range(4):
                d_planes[c, r, x] = ZERO
            if left + x < width and top + r < height:
                y = top + r
                last[r, x] = last_in[y, left + x]
                through[r, x] = rest[y, left + x]
                behind[r, x] = -d_alpha[y, left + x] * rest[y, left + x]
                for c in range(3):
                    d_planes[c, r, x] = d_image[y, left + x, c]
                d_planes[3, r, x] = d_depth[y, left + x]
                last_of_row[r] = max(last_of_row[r], last[r, x])
        far = max(far, last_of_row[r])
    return far


@part
def load_tile_labels(left: int, top: int, d_labels: Array, tile_labels: Array) -> None:
    height, width, channels = d_labels.shape
    for r in range(TILE):
        for x in range(TILE):
            inside = left + x < width and top + r < height
            for c in range(channels):
                tile_labels[r * TILE + x, c] = d_labels[top + r, left + x, c] if inside else ZERO


@part
def unblend_row(
    place: int,
    raw: Array,
    last: Array,
    through: Array,
    behind: Array,
    d_planes: Array,
    r: int,
    record: Array,
    weight: Array,
    d_log_alpha: Array,
) -> None:
    """Step back over one Gaussian on one row: its weight [16] and dL/d(ln raw alpha) [16], zero where it was
    not blended."""
    for x in range(TILE):
        capped = min(raw[x], ALPHA_CAP)
        blended = capped >= ALPHA_LEAST and place <= last[r, x]
        alpha = capped if blended else ZERO
        over = ONE / (ONE - alpha)
        before = through[r, x] * over
        value = (
            record[RED] * d_planes[0, r, x]
            + record[GREEN] * d_planes[1, r, x]
            + record[BLUE] * d_planes[2, r, x]
            + record[DEPTH] * d_planes[3, r, x]
        )
        slope = before * value - behind[r, x] * over
        weight[x] = alpha * before
        behind[r, x] += alpha * before * value
        through[r, x] = before
        d_log_alpha[x] = alpha * slope if raw[x] <= ALPHA_CAP else ZERO


@contracted_part
def add_moments(d_log_alpha: Array, weight: Array, s1: Array, s2: float, d_planes: Array, r: int, sums: Array) -> None:
    for x in range(TILE):
        g = d_log_alpha[x]
        t = g * s1[x]
        sums[0, x] += g
        sums[1, x] += t
        sums[2, x] += t * s1[x]
        sums[3, x] += g * s2
        sums[4, x] += t * s2
        sums[5, x] += g * (s2 * s2)
    for c in range(4):
        for x in range(TILE):
            sums[D_BLUE - 2 + c, x] += weight[x] * d_planes[c, r, x]


@part
def add_label_gradients(
    counts: Array,
    weights: Array,
    members: Array,
    tile_labels: Array,
    chunk_labels: Array,
    pixels: Array,
    channels: int,
) -> None:
    """chunk_labels [CHUNK + 1, C] += each member's weights times the pixels' label gradients, row after
    row."""
    for r in range(TILE):
        used = counts[r]
        if used == 0:
            continue
        padded = (used + 3) // 4 * 4
        for k in range(used, padded):
            members[r, k] = CHUNK  # a place that nobody reads
            weights[r, k, :] = ZERO
        add_products(
            chunk_labels,
            members[r],
            weights[r],
            (padded, TILE),
            tile_labels,
            pixels[r * TILE : (r + 1) * TILE],
            channels,
        )
        counts[r] = 0


@parallel_kernel
def unblend_tiles(
    worker: int,
    workers: int,
    next_tile: Array,
    starts: Array,
    tile_ids: Array,
    tile_slots: Array,
    flat_records: Array,
    flat_rest: Array,
    flat_last: Array,
    flat_d_image: Array,
    flat_d_labels: Array,
    channels: int,
    flat_d_alpha: Array,
    flat_d_depth: Array,
    width: int,
    height: int,
    touched: Array,
    slot_gradients: Array,
    slot_labels: Array,
    scratches: Array,
    member_lists: Array,
    row_counts: Array,
) -> None:
    """Every ``workers``-th tile; arguments as those of its fast twin, which alone uses the last three."""
    records = flat_records.reshape(flat_records.size // RECORD, RECORD)
    rest = flat_rest.reshape(height, width)
    last_in = flat_last.reshape(height, width)
    d_image = flat_d_image.reshape(height, width, 3)
    # with no labels there is nothing to reshape, but the rows and columns are still asked for
    d_labels = flat_d_labels.reshape(height, width, channels)
    d_alpha = flat_d_alpha.reshape(height, width)
    d_depth = flat_d_depth.reshape(height, width)
    columns = (width + TILE - 1) // TILE
    padded = padded_channels(channels)
    s1_left = np.empty(TILE, np.float32)
    s2 = np.empty(TILE, np.float32)
    s1 = np.empty(TILE, np.float32)
    raw = np.empty(TILE, np.float32)
    bits = raw.view(np.int32)
    d_log_alpha = np.empty(TILE, np.float32)
    through = np.empty((TILE, TILE), np.float32)
    behind = np.empty((TILE, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    last_of_row = np.empty(TILE, np.int32)
    d_planes = np.empty((4, TILE, TILE), np.float32)
    sums = np.empty((GRADIENT, TILE), np.float32)
    tile_labels = np.empty((TILE * TILE, channels), np.float32)
    counts = np.zeros(TILE, np.int64)
    weights = np.empty((TILE, CHUNK, TILE), np.float32)
    members = np.empty((TILE, CHUNK), np.int32)
    chunk_labels = np.empty((CHUNK + 1, channels), np.float32)
    pixels = np.arange(TILE * TILE)
    for tile in range(worker, starts.shape[0] - 1, workers):
        left = tile % columns * TILE
        top = tile // columns * TILE
        first = starts[tile]
        far = load_tile(
            left, top, rest, last_in, d_image, d_alpha, d_depth, through, behind, last, d_planes, last_of_row
        )
        for k in range(first, starts[tile + 1]):
            touched[tile_slots[k]] = 0
        if far < 0:
            continue
        if channels > 0:
            load_tile_labels(left, top, d_labels, tile_labels)
        for chunk in range(far // CHUNK * CHUNK, -1, -CHUNK):
            chunk_labels[:] = ZERO
            for place in range(min(chunk + CHUNK - 1, far), chunk - 1, -1):
                record = records[tile_ids[first + place]]
                rows = whiten_rows(record, left, top, s1_left, s2)
                sums[:] = ZERO
                for r in range(TILE):
                    if not (rows >> r) & 1 or place > last_of_row[r]:
                        continue
                    alpha_row(s1_left[r], record[L11], s2[r], record[OPACITY], s1, raw, bits)
                    weight = weights[r, counts[r]]
                    unblend_row(place, raw, last, through, behind, d_planes, r, record, weight, d_log_alpha)
                    add_moments(d_log_alpha, weight, s1, s2[r], d_planes, r, sums)
                    members[r, counts[r]] = place - chunk
                    counts[r] += 1
                slot = tile_slots[first + place]
                touched[slot] = 1
                for c in range(GRADIENT):
                    total = ZERO
                    for x in range(TILE):
                        total += sums[c, x]
                    slot_gradients[slot * GRADIENT_WIDTH + c] = total
            if channels > 0:
                add_label_gradients(counts, weights, members, tile_labels, chunk_labels, pixels, channels)
                for place in range(chunk, min(chunk + CHUNK, far + 1)):
                    for c in range(channels):
                        slot_labels[tile_slots[first + place] * padded + c] = chunk_labels[place - chunk, c]
            else:
                counts[:] = 0
