"""Which Gaussians each tile of the picture draws, front to back.

Visible Gaussians are sorted by depth (radix sort, least significant digit first; it is stable, so that ties keep the
order of their indices). Then each worker takes a stretch of that order and scatters it to the tiles' lists. The result
does not depend on how many workers there are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine import memory
from ..machine.compiled import Array, compiled, device_function, parallel_kernel
from ..machine.threads import parallel_for
from .arrays import Intersections
from .chunks import chunk_range
from .records import TILE

DIGIT_BITS = 11
DIGITS = 1 << DIGIT_BITS
DIGIT_PASSES = 3
"""Passes of the radix sort. 33 bits are more than the 32 of a depth."""
WORTH_SHARING = 1000
"""Fewer intersections than this are scattered by one worker: waking the others would take longer."""


def isect_tiles(
    workers: int,
    boxes: NDArray[np.int32],
    depths: NDArray[np.float32],
    counts: NDArray[np.int64],
    width: int,
    height: int,
) -> tuple[Intersections, int]:
    """The intersections of a picture of ``width`` times ``height`` pixels, and the length of the longest tile's list.

    ``boxes`` [N, 4] and ``depths`` [N] as in ``Projected``; ``counts`` [chunks, 2]: the visible Gaussians of each
    chunk, and the tiles that they touch.
    """
    shown, count = counts.sum(axis=0).tolist()
    columns, rows = -(-width // TILE), -(-height // TILE)
    workers = workers if count >= WORTH_SHARING else 1
    isects = Intersections(
        *memory.several(
            (len(boxes) + 1, np.int64), (columns * rows + 1, np.int64), (count, np.int32), (count, np.int32)
        )
    )
    keys, order = memory.several(((2, shown), np.uint32), ((2, shown), np.int32))
    places = np.zeros((workers, columns * rows), np.int64)
    parallel_for(1, sort_by_depth, boxes, depths.view(np.uint32), keys, order, isects.gaussian_offsets)
    parallel_for(workers, count_tiles, order[DIGIT_PASSES % 2], boxes, columns, places)
    longest = running_starts(places, isects.isect_offsets)
    parallel_for(workers, scatter_tiles, order[DIGIT_PASSES % 2], boxes, columns, places, isects)
    return isects, int(longest)


def blending_workers(workers: int, isects: Intersections, longest: int) -> int:
    """How many workers blend. Each has room for the longest list, so there are no more of them than such lists."""
    return min(workers, max(1, -(-len(isects.flatten_ids) // max(1, longest))))


@device_function
def list_visible(boxes: Array, depth_bits: Array, keys: Array, ids: Array, gaussian_offsets: Array) -> None:
    """Keys and ids of the visible Gaussians in the order of their indices, and the running sum of touched tiles."""
    place, isect = 0, 0
    for i in range(boxes.shape[0]):
        gaussian_offsets[i] = isect
        tiles = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        if tiles > 0:
            keys[place] = depth_bits[i]  # depths are positive, so their bits sort as they do
            ids[place] = i
            place += 1
            isect += tiles
    gaussian_offsets[boxes.shape[0]] = isect


@parallel_kernel
def sort_by_depth(
    worker: int, workers: int, boxes: Array, depth_bits: Array, keys: Array, order: Array, gaussian_offsets: Array
) -> None:
    """Fill row DIGIT_PASSES % 2 of ``order`` int32 [2, V] with the V visible Gaussians, nearest first, and fill
    ``gaussian_offsets``. One worker does it all; ``keys`` uint32 [2, V] and the other row are room to work in."""
    list_visible(boxes, depth_bits, keys[0], order[0], gaussian_offsets)
    for digit_pass in range(DIGIT_PASSES):
        shift, source, target = np.uint32(DIGIT_BITS * digit_pass), digit_pass % 2, 1 - digit_pass % 2
        places = np.zeros(DIGITS + 1, np.int64)
        for i in range(keys.shape[1]):
            places[((keys[source, i] >> shift) & np.uint32(DIGITS - 1)) + 1] += 1
        for digit in range(DIGITS):
            places[digit + 1] += places[digit]
        for i in range(keys.shape[1]):
            digit = (keys[source, i] >> shift) & np.uint32(DIGITS - 1)
            place = places[digit]
            places[digit] = place + 1
            keys[target, place] = keys[source, i]
            order[target, place] = order[source, i]


@parallel_kernel
def count_tiles(worker: int, workers: int, order: Array, boxes: Array, columns: int, counts: Array) -> None:
    """Add to ``counts`` int64 [workers, tiles] how many Gaussians of the worker's stretch are on each tile."""
    first, end = chunk_range(worker, workers, order.shape[0])
    for k in range(first, end):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                counts[worker, row * columns + column] += 1


@compiled
def running_starts(counts: Array, starts: Array) -> Any:
    """Counts [workers, tiles] become the places where each worker begins in each tile; ``starts`` [tiles + 1] gets the
    tiles' places. Returns the largest tile's count."""
    workers, tiles = counts.shape
    total, largest = 0, 0
    for tile in range(tiles):
        starts[tile] = total
        for worker in range(workers):
            own = counts[worker, tile]
            counts[worker, tile] = total
            total += own
        largest = max(largest, total - starts[tile])
    starts[tiles] = total
    return largest


@parallel_kernel
def scatter_tiles(
    worker: int, workers: int, order: Array, boxes: Array, columns: int, places: Array, out: Intersections
) -> None:
    """Fill ``flatten_ids`` and ``isect_ids`` from the worker's stretch."""
    first, end = chunk_range(worker, workers, order.shape[0])
    for k in range(first, end):
        i = order[k]
        isect = out.gaussian_offsets[i]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * columns + column
                place = places[worker, tile]
                places[worker, tile] = place + 1
                out.flatten_ids[place] = i
                out.isect_ids[place] = isect
                isect += 1
