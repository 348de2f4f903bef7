"""Back-to-front gradients of the blending, plain Numba: the readable twin.

Walking back, T_i = T_{i+1} / (1 - alpha_i) and one running sum per pixel is all that is needed:
with v_i = colour_i . dL/dimage + z_i * dL/ddepth and S_i = sum_{j>i} w_j v_j - T_end * dL/dalpha,
dL/dalpha_i = T_i v_i - S_i / (1 - alpha_i). (Carrying the alpha output as a final term keeps it exact where
T_end is tiny.) Each Gaussian's gradient in each tile goes to a place of its own; a later pass adds them in
order.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...machine.compiled import Array, contracted_device_function, device_function, parallel_kernel
from ..arrays import Intersections, IsectGradients, PixelGradients, Scratch, Size
from ..records import (
    BATCH,
    BLUE,
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
from .footprint import ALPHA_CAP, F, add_product, alpha_row, whiten_rows
from .forward import ALPHA_LEAST, ONE

ZERO = F(0.0)


class TileState(NamedTuple):
    """A tile in the backward pass: ``transmittance``, what lies ``behind`` (S_i) float32 and ``last`` int32 [16, 16],
    the gradients of red, green, blue and depth in ``planes`` float32 [4, 16, 16], ``last_of_row`` int32 [16]."""

    transmittance: Array
    behind: Array
    last: Array
    planes: Array
    last_of_row: Array


@device_function
def load_tile(left: int, top: int, pixels: PixelGradients, state: TileState) -> Any:
    """The tile's state at its far end; zeros outside the image. Returns the largest place blended in the tile.
    ``pixels`` is shaped as a picture."""
    height, width = pixels.final.shape
    last, last_of_row, planes = state.last, state.last_of_row, state.planes
    far = -1
    for r in range(TILE):
        last_of_row[r] = -1
        for x in range(TILE):
            last[r, x] = -1
            state.transmittance[r, x] = ONE
            state.behind[r, x] = ZERO
            for c in range(4):
                planes[c, r, x] = ZERO
            if left + x < width and top + r < height:
                y = top + r
                last[r, x] = pixels.last[y, left + x]
                state.transmittance[r, x] = pixels.final[y, left + x]
                state.behind[r, x] = -pixels.alpha[y, left + x] * pixels.final[y, left + x]
                for c in range(3):
                    planes[c, r, x] = pixels.image[y, left + x, c]
                planes[3, r, x] = pixels.depth[y, left + x]
                last_of_row[r] = max(last_of_row[r], last[r, x])
        far = max(far, last_of_row[r])
    return far


@device_function
def load_tile_labels(left: int, top: int, d_labels: Array, tile_labels: Array) -> None:
    height, width, channels = d_labels.shape
    for r in range(TILE):
        for x in range(TILE):
            inside = left + x < width and top + r < height
            for c in range(channels):
                tile_labels[r * TILE + x, c] = d_labels[top + r, left + x, c] if inside else ZERO


@device_function
def blend_row_backward(
    place: int, raw: Array, state: TileState, r: int, record: Array, weight: Array, d_log_alpha: Array
) -> None:
    """Step back over one Gaussian on one row: its weight [16] and dL/d(ln raw alpha) [16], zero where it was not
    blended."""
    transmittance, behind, planes = state.transmittance, state.behind, state.planes
    for x in range(TILE):
        capped = min(raw[x], ALPHA_CAP)
        blended = capped >= ALPHA_LEAST and place <= state.last[r, x]
        alpha = capped if blended else ZERO
        over = ONE / (ONE - alpha)
        before = transmittance[r, x] * over
        value = (
            record[RED] * planes[0, r, x]
            + record[GREEN] * planes[1, r, x]
            + record[BLUE] * planes[2, r, x]
            + record[DEPTH] * planes[3, r, x]
        )
        slope = before * value - behind[r, x] * over
        weight[x] = alpha * before
        behind[r, x] += alpha * before * value
        transmittance[r, x] = before
        d_log_alpha[x] = alpha * slope if raw[x] <= ALPHA_CAP else ZERO


@contracted_device_function
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


@device_function
def add_label_gradients(
    counts: Array,
    weights: Array,
    members: Array,
    tile_labels: Array,
    batch_labels: Array,
    pixels: Array,
    channels: int,
) -> None:
    """batch_labels [BATCH + 1, C] += each member's weights times the pixels' label gradients, row after
    row."""
    for r in range(TILE):
        used = counts[r]
        if used == 0:
            continue
        padded = (used + 3) // 4 * 4
        for k in range(used, padded):
            members[r, k] = BATCH  # a place that nobody reads
            weights[r, k, :] = ZERO
        add_product(
            batch_labels,
            members[r],
            weights[r],
            (padded, TILE),
            tile_labels,
            pixels[r * TILE : (r + 1) * TILE],
            channels,
        )
        counts[r] = 0


@parallel_kernel
def blend_backward(
    worker: int,
    workers: int,
    isects: Intersections,
    records: Array,
    pixels: PixelGradients,
    size: Size,
    out: IsectGradients,
    scratches: Scratch,
) -> None:
    """Every ``workers``-th tile; as its vector twin, which alone uses the scratch."""
    starts, flatten_ids, isect_ids = isects.isect_offsets, isects.flatten_ids, isects.isect_ids
    width, height, channels = size.width, size.height, size.channels
    rows_of_records = records.reshape(records.size // RECORD, RECORD)
    # with no labels there is nothing to reshape, but the rows and columns are still asked for
    d_labels = pixels.labels.reshape(height, width, channels)
    picture = PixelGradients(
        pixels.image.reshape(height, width, 3),
        d_labels,
        pixels.alpha.reshape(height, width),
        pixels.depth.reshape(height, width),
        pixels.final.reshape(height, width),
        pixels.last.reshape(height, width),
    )
    columns = (width + TILE - 1) // TILE
    padded = padded_channels(channels)
    s1_left = np.empty(TILE, np.float32)
    s2 = np.empty(TILE, np.float32)
    s1 = np.empty(TILE, np.float32)
    raw = np.empty(TILE, np.float32)
    bits = raw.view(np.int32)
    d_log_alpha = np.empty(TILE, np.float32)
    state = TileState(
        np.empty((TILE, TILE), np.float32),
        np.empty((TILE, TILE), np.float32),
        np.empty((TILE, TILE), np.int32),
        np.empty((4, TILE, TILE), np.float32),
        np.empty(TILE, np.int32),
    )
    sums = np.empty((GRADIENT, TILE), np.float32)
    tile_labels = np.empty((TILE * TILE, channels), np.float32)
    counts = np.zeros(TILE, np.int64)
    weights = np.empty((TILE, BATCH, TILE), np.float32)
    members = np.empty((TILE, BATCH), np.int32)
    batch_labels = np.empty((BATCH + 1, channels), np.float32)
    numbers = np.arange(TILE * TILE)
    for number in range(worker, starts.shape[0] - 1, workers):
        left, top = number % columns * TILE, number // columns * TILE
        first = starts[number]
        far = load_tile(left, top, picture, state)
        for k in range(first, starts[number + 1]):
            out.touched[isect_ids[k]] = 0
        if far < 0:
            continue
        if channels > 0:
            load_tile_labels(left, top, d_labels, tile_labels)
        for batch in range(far // BATCH * BATCH, -1, -BATCH):
            batch_labels[:] = ZERO
            for place in range(min(batch + BATCH - 1, far), batch - 1, -1):
                record = rows_of_records[flatten_ids[first + place]]
                rows = whiten_rows(record, left, top, s1_left, s2)
                sums[:] = ZERO
                for r in range(TILE):
                    if not (rows >> r) & 1 or place > state.last_of_row[r]:
                        continue
                    alpha_row(s1_left[r], record[L11], s2[r], record[OPACITY], s1, raw, bits)
                    weight = weights[r, counts[r]]
                    blend_row_backward(place, raw, state, r, record, weight, d_log_alpha)
                    add_moments(d_log_alpha, weight, s1, s2[r], state.planes, r, sums)
                    members[r, counts[r]] = place - batch
                    counts[r] += 1
                isect = isect_ids[first + place]
                out.touched[isect] = 1
                for c in range(GRADIENT):
                    total = ZERO
                    for x in range(TILE):
                        total += sums[c, x]
                    out.values[isect * GRADIENT_WIDTH + c] = total
            if channels > 0:
                add_label_gradients(counts, weights, members, tile_labels, batch_labels, numbers, channels)
                for place in range(batch, min(batch + BATCH, far + 1)):
                    for c in range(channels):
                        out.labels[isect_ids[first + place] * padded + c] = batch_labels[place - batch, c]
            else:
                counts[:] = 0
