"""The Gaussians that made each pixel: its largest blending weights."""

from __future__ import annotations

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ..arrays import Intersections
from ..records import L11, OPACITY, TILE
from .footprint import F, alpha_row, whiten_rows
from .forward import any_alive, blend_row, start_tile


@device_function
def keep_largest(gaussian: int, weight: float, indices: Array, weights: Array) -> None:
    """Put one contributor into a pixel's lists, largest first; of two equal ones the front one stays
    first."""
    place = weights.shape[0] - 1
    if weight <= weights[place]:
        return
    while place > 0 and weight > weights[place - 1]:
        weights[place] = weights[place - 1]
        indices[place] = indices[place - 1]
        place -= 1
    weights[place] = weight
    indices[place] = gaussian


@parallel_kernel
def list_contributors(
    worker: int, workers: int, isects: Intersections, records: Array, indices: Array, weights: Array
) -> None:
    """Every ``workers``-th tile: indices int32 [H, W, k] and weights [H, W, k]; -1 and 0 where there are
    fewer than k."""
    starts, flatten_ids = isects.isect_offsets, isects.flatten_ids
    height, width, wanted = weights.shape
    columns = (width + TILE - 1) // TILE
    s1_left = np.empty(TILE, np.float32)
    s2 = np.empty(TILE, np.float32)
    s1 = np.empty(TILE, np.float32)
    raw = np.empty(TILE, np.float32)
    bits = raw.view(np.int32)
    row_weights = np.empty(TILE, np.float32)
    transmittance = np.empty((TILE, TILE), np.float32)
    last = np.empty((TILE, TILE), np.int32)
    for tile in range(worker, starts.shape[0] - 1, workers):
        left = tile % columns * TILE
        top = tile // columns * TILE
        start_tile(width, height, left, top, transmittance, last)
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                for c in range(wanted):
                    indices[y, x, c] = -1
                    weights[y, x, c] = F(0.0)
        for k in range(starts[tile], starts[tile + 1]):
            if (k - starts[tile]) % TILE == 0 and any_alive(transmittance) == 0:
                break
            record = records[flatten_ids[k]]
            rows = whiten_rows(record, left, top, s1_left, s2)
            for r in range(TILE):
                if not (rows >> r) & 1:
                    continue
                alpha_row(s1_left[r], record[L11], s2[r], record[OPACITY], s1, raw, bits)
                blend_row(raw, transmittance[r], row_weights)
                for x in range(TILE):
                    if row_weights[x] > F(0.0):
                        keep_largest(
                            flatten_ids[k],
                            row_weights[x],
                            indices[top + r, left + x],
                            weights[top + r, left + x],
                        )
