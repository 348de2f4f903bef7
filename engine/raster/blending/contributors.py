"""Finds the Gaussians with the largest weights in each pixel, and the depth of the surface there, with exactly the
blending weights of the forward pass."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine import vectors as v
from ...machine.compiled import Array, device_function, parallel_kernel
from ..arrays import Intersections, Tile
from ..conventions import DEPTH, L11, RECORD, TILE
from .backward import EXPONENTS, S1_LEFT, WHITENED, whiten_tile
from .forward import ENDED, NEARLY_NOTHING, ONE, ZERO, F, seen_alpha

HALF = F(0.5)

# a worker's scratch, in floats: the pixels' transmittance, a Gaussian's whitened rows, sums over a pixel's contributors
# (all weights, those up to the median, and for those near it their weights and w (z - median)), and listed weights
TRANSMITTANCE, OWN = 0, TILE * TILE
TOTAL = OWN + WHITENED
REACHED, MEDIAN, WEIGHT = TOTAL + TILE * TILE, TOTAL + 2 * TILE * TILE, TOTAL + 3 * TILE * TILE
OFFSET, LISTED = TOTAL + 4 * TILE * TILE, TOTAL + 5 * TILE * TILE


def scratch_sizes(longest: int) -> tuple[int, int]:
    """Return how many floats and integers of scratch a worker needs, if tiles have at most ``longest`` Gaussians."""
    return LISTED + (longest * TILE + 1) * TILE, 2 * (longest * TILE + 1)


@device_function
def any_alive(floats: Array) -> bool:
    """Whether any pixel of the tile, with its state in the scratch ``floats``, can still show what is further back."""
    for at in range(0, TILE * TILE, TILE):
        if v.movemask(v.load(floats, TRANSMITTANCE + at) > v.broadcast(ENDED)) != 0:
            return True
    return False


@device_function
def blend_row(records: Array, at: int, r: int, floats: Array, to: int) -> bool:
    """Blend the Gaussian records[at:] on a tile's row ``r``; write weights to floats[to:]. Return if any is above 0."""
    s1 = v.fma(v.broadcast_load(records, at + L11), v.lane_numbers(), v.broadcast_load(floats, OWN + S1_LEFT + r))
    alpha = seen_alpha(v.exp2(v.fnmadd(s1, s1, v.broadcast_load(floats, OWN + EXPONENTS + r))))
    before = v.load(floats, TRANSMITTANCE + r * TILE)
    after = v.fnmadd(alpha, before, before)
    blended = (alpha > v.broadcast(ZERO)) & (after > v.broadcast(ENDED))
    v.store(floats, TRANSMITTANCE + r * TILE, v.maximum(after, v.broadcast(NEARLY_NOTHING)))
    v.store(floats, to, v.select(blended, alpha * before, v.broadcast(ZERO)))
    return v.movemask(blended) != 0


@device_function
def blend_tile(tile: Tile, size: tuple[int, int], flatten_ids: Array, records: Array, scratch: Any) -> int:
    """Blend a tile's Gaussians row by row, front to back, until all pixels are closed. Write each pair of Gaussian and
    row that contributes, with its weights, to ``scratch``, and return the number of pairs."""
    floats, members = scratch
    rows, count = min(TILE, size[1] - tile.top), 0
    for r in range(TILE):
        inside = v.lane_numbers() < v.broadcast(F(size[0] - tile.left if r < rows else 0))
        v.store(floats, TRANSMITTANCE + r * TILE, v.select(inside, v.broadcast(ONE), v.broadcast(ZERO)))
    for k in range(tile.length):
        if k % TILE == 0 and not any_alive(floats):  # it looks at all rows, so not after each Gaussian
            break
        gaussian = v.get(flatten_ids, tile.first + k)
        patches = whiten_tile(records, int(gaussian) * RECORD, tile, floats, OWN)
        for r in range(rows):
            if (patches >> (r & -2)) & 3 == 0:  # neither patch of the row's strip is touched
                continue
            # an entry that no pixel shows is overwritten
            if blend_row(records, int(gaussian) * RECORD, r, floats, LISTED + count * TILE):
                v.put(members, 2 * count, gaussian)
                v.put(members, 2 * count + 1, np.int32(r))
                count += 1
    return count


@device_function
def tile_of(number: int, width: int, starts: Array) -> Tile:
    across, first = (width + TILE - 1) // TILE, starts[number]
    return Tile(number % across * TILE, number // across * TILE, first, starts[number + 1] - first)


@device_function
def keep_largest(gaussian: int, weight: float, indices: Array, weights: Array) -> None:
    """Insert a Gaussian into a pixel's lists, largest weight first. Of equal weights the nearer Gaussian is first."""
    rank = weights.shape[0] - 1
    if weight <= weights[rank]:
        return
    while rank > 0 and weight > weights[rank - 1]:
        weights[rank] = weights[rank - 1]
        indices[rank] = indices[rank - 1]
        rank -= 1
    weights[rank] = weight
    indices[rank] = gaussian


@parallel_kernel
def list_contributors(
    worker: int, workers: int, isects: Intersections, records: Array, scratches: Any, indices: Array, weights: Array
) -> None:
    """Fill ``indices`` int32 [H, W, k] and ``weights`` [H, W, k] in every ``workers``-th tile. The caller initialises
    them to -1 and 0, which stay where a pixel has fewer than k. ``records`` float32 [N * RECORD]; ``scratches``: arrays
    of `scratch_sizes` per worker."""
    size = (weights.shape[1], weights.shape[0])
    floats, members = scratches[0][worker], scratches[1][worker]
    for number in range(worker, isects.isect_offsets.shape[0] - 1, workers):
        tile = tile_of(number, size[0], isects.isect_offsets)
        for pair in range(blend_tile(tile, size, isects.flatten_ids, records, (floats, members))):
            gaussian, y = v.get(members, 2 * pair), tile.top + v.get(members, 2 * pair + 1)
            for x in range(tile.left, min(tile.left + TILE, size[0])):
                weight = v.get(floats, LISTED + pair * TILE + x - tile.left)
                if weight > ZERO:
                    keep_largest(gaussian, weight, indices[y, x], weights[y, x])


# The depth of the surface.
#
# At an outline a pixel blends what is in front with what is behind. The mean depth lies between the two, where there
# is nothing. The median, at which half of the weight is reached, lies on one of the two, but from pixel to
# pixel it jumps between the Gaussians of a surface. So it only chooses the Gaussians whose mean is taken.


@device_function
def sum_near_median(count: int, records: Array, floats: Array, members: Array, reach: Array) -> None:
    """Compute pixels' median depth and the sums for the mean near it (``reach``), from ``count`` listed pairs."""
    share, metres = v.broadcast(reach[0]), v.broadcast(reach[1])
    for at in range(TOTAL, LISTED, TILE):
        v.store(floats, at, v.broadcast(ZERO))
    for pair in range(count):
        at = TILE * v.get(members, 2 * pair + 1)
        v.store(floats, TOTAL + at, v.load(floats, TOTAL + at) + v.load(floats, LISTED + pair * TILE))
    for pair in range(count):
        at, weight = TILE * v.get(members, 2 * pair + 1), v.load(floats, LISTED + pair * TILE)
        depth = v.broadcast_load(records, RECORD * int(v.get(members, 2 * pair)) + DEPTH)
        reached = v.load(floats, REACHED + at)
        is_median = (weight > v.broadcast(ZERO)) & (reached < v.load(floats, TOTAL + at) * v.broadcast(HALF))
        v.store(floats, MEDIAN + at, v.select(is_median, depth, v.load(floats, MEDIAN + at)))
        v.store(floats, REACHED + at, reached + weight)
    for pair in range(count):
        at = TILE * v.get(members, 2 * pair + 1)
        median = v.load(floats, MEDIAN + at)
        gap = v.broadcast_load(records, RECORD * int(v.get(members, 2 * pair)) + DEPTH) - median
        is_near = v.maximum(gap, v.broadcast(ZERO) - gap) <= median * share + metres
        weight = v.select(is_near, v.load(floats, LISTED + pair * TILE), v.broadcast(ZERO))
        v.store(floats, WEIGHT + at, v.load(floats, WEIGHT + at) + weight)
        v.store(floats, OFFSET + at, v.fma(weight, gap, v.load(floats, OFFSET + at)))


@parallel_kernel
def find_surface(
    worker: int, workers: int, isects: Intersections, records: Array, scratches: Any, depth: Array, width: int,
    reach: Array,
) -> None:  # fmt: skip
    """Fill ``depth`` float32 [H * W], metres, 0 where nothing is drawn, in every ``workers``-th tile. ``reach`` float32
    [2] is `Pinhole.surface_reach`. The other arguments are those of `list_contributors`."""
    size = (width, depth.shape[0] // width)
    floats, members = scratches[0][worker], scratches[1][worker]
    for number in range(worker, isects.isect_offsets.shape[0] - 1, workers):
        tile = tile_of(number, width, isects.isect_offsets)
        count = blend_tile(tile, size, isects.flatten_ids, records, (floats, members))
        sum_near_median(count, records, floats, members, reach)
        inside = v.lane_numbers() < v.broadcast(F(width - tile.left))
        for r in range(min(TILE, size[1] - tile.top)):
            weight = v.maximum(v.load(floats, WEIGHT + r * TILE), v.broadcast(NEARLY_NOTHING))  # never 0 / 0
            mean = v.load(floats, MEDIAN + r * TILE) + v.load(floats, OFFSET + r * TILE) / weight
            v.masked_store(depth, (tile.top + r) * width + tile.left, mean, inside)
