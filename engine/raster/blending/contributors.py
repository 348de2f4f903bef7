"""The Gaussians that contribute most to each pixel, with exactly the blending weights of the forward pass."""

from __future__ import annotations

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ...machine.vectors import (
    broadcast,
    broadcast_load,
    exp2,
    fma,
    fnmadd,
    get,
    lane_numbers,
    load,
    maximum,
    movemask,
    select,
    store,
    trailing_zeros,
)
from ..arrays import Intersections, Tile
from ..conventions import L11, RECORD, TILE
from .backward import EXPONENTS, S1_LEFT, WHITENED, whiten_tile
from .forward import ENDED, NEARLY_NOTHING, ONE, ZERO, seen_alpha


@device_function
def start_tile(tile: Tile, transmittance: Array, indices: Array, weights: Array) -> None:
    """Start with empty lists, and a transmittance of one inside the image and of zero outside."""
    height, width = weights.shape[:2]
    for r in range(TILE):
        for c in range(TILE):
            y, x = tile.top + r, tile.left + c
            inside = y < height and x < width
            transmittance[r * TILE + c] = ONE if inside else ZERO
            if inside:
                indices[y, x, :] = -1
                weights[y, x, :] = ZERO


@device_function
def any_alive(transmittance: Array) -> bool:
    """Whether any pixel of the tile still sees anything."""
    for at in range(0, TILE * TILE, TILE):
        if movemask(load(transmittance, at) > broadcast(ENDED)) != 0:
            return True
    return False


@device_function
def blend_row(records: Array, at: int, r: int, whitened: Array, transmittance: Array, weights: Array) -> int:
    """Blend one Gaussian on one row of a tile: fill ``weights`` [16], and return the mask of the pixels it is on."""
    s1 = fma(broadcast_load(records, at + L11), lane_numbers(), broadcast_load(whitened, S1_LEFT + r))
    alpha = seen_alpha(exp2(fnmadd(s1, s1, broadcast_load(whitened, EXPONENTS + r))))
    before = load(transmittance, r * TILE)
    after = fnmadd(alpha, before, before)
    blended = (alpha > broadcast(ZERO)) & (after > broadcast(ENDED))
    store(transmittance, r * TILE, maximum(after, broadcast(NEARLY_NOTHING)))
    store(weights, 0, select(blended, alpha * before, broadcast(ZERO)))
    return movemask(blended)


@device_function
def keep_largest(gaussian: int, weight: float, indices: Array, weights: Array) -> None:
    """Put one contributor into a pixel's lists, largest first. Of two equal ones, the one in front stays first."""
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
    """Fill every ``workers``-th tile of indices int32 [H, W, k] and weights [H, W, k]; -1 and 0 if there are fewer than
    k. ``records`` float32 [N * RECORD]."""
    starts, flatten_ids = isects.isect_offsets, isects.flatten_ids
    height, width = weights.shape[:2]
    columns = (width + TILE - 1) // TILE
    whitened, own = np.empty(WHITENED, np.float32), np.empty(TILE, np.float32)
    transmittance = np.empty(TILE * TILE, np.float32)
    for number in range(worker, starts.shape[0] - 1, workers):
        left, top, first = number % columns * TILE, number // columns * TILE, starts[number]
        tile = Tile(left, top, first, starts[number + 1] - first)
        start_tile(tile, transmittance, indices, weights)
        for k in range(first, starts[number + 1]):
            if (k - first) % TILE == 0 and not any_alive(transmittance):
                break
            gaussian = int(get(flatten_ids, k))
            patches = whiten_tile(records, gaussian * RECORD, tile, whitened, 0)
            for r in range(min(TILE, height - top)):
                if (patches >> (r & -2)) & 3 == 0:
                    continue
                pixels = blend_row(records, gaussian * RECORD, r, whitened, transmittance, own)
                while pixels != 0:
                    x = trailing_zeros(pixels)
                    pixels &= pixels - 1
                    keep_largest(gaussian, own[x], indices[top + r, left + x], weights[top + r, left + x])
