"""Lists the Gaussians that each tile of the picture draws, front to back.

Visible Gaussians are sorted by depth. Then each worker takes a part of that order and writes it into the tiles' lists.
The result does not depend on the number of workers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine import memory
from ..machine.compiled import Array, compiled, device_function, parallel_kernel
from ..machine.threads import parallel_for
from ..machine.vectors import fetch_add
from .arrays import Intersections
from .conventions import TILE

# Chunks of Gaussians. A worker that has finished one takes the next. With equal shares, the slowest worker, or one that
# wakes late, would hold up all others.

CHUNK = 256
"""The approximate number of Gaussians in a chunk. Smaller chunks would cost more to hand out."""
MOST_CHUNKS = 256
"""The largest number of chunks, which is several for each of many workers."""


@device_function
def chunk_count(count: int) -> int:
    """Return into how many chunks ``count`` Gaussians are divided, at least 1."""
    return max(1, min(MOST_CHUNKS, (count + CHUNK - 1) // CHUNK))


@device_function
def chunk_range(chunk: int, chunks: int, count: int) -> Any:
    """Return the first Gaussian of a chunk and the first after it, for ``count`` Gaussians in ``chunks`` chunks."""
    return count * chunk // chunks, count * (chunk + 1) // chunks


@device_function
def next_chunk(next_one: Array, chunks: int, count: int) -> Any:
    """Take the next chunk, atomically, and return its ``chunk_range``, which is empty if all have been taken."""
    first, end = chunk_range(fetch_add(next_one), chunks, count)
    return first, min(end, count)


WORTH_SHARING = 1000
"""Below this many intersections one worker scatters alone, as waking the others would take longer."""


def isect_tiles(
    workers: int, boxes: NDArray[np.int32], depths: NDArray[np.float32], width: int, height: int
) -> tuple[Intersections, int]:
    """Return the tiles' lists for a picture of ``width`` x ``height`` pixels, and the length of the longest list.
    ``boxes`` int32 [N, 4] and ``depths`` float32 [N] as in ``Projected``."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    offsets, keys = memory.several((len(boxes) + 1, np.int64), (len(boxes), np.uint64))
    keys = keys[: list_visible(boxes, depths.view(np.uint32), keys, offsets)]
    keys.sort()  # the index in each key settles ties
    count = int(offsets[-1])
    workers = workers if count >= WORTH_SHARING else 1
    order, *listed = memory.several(
        (len(keys), np.int32), (columns * rows + 1, np.int64), (count, np.int32), (count, np.int32)
    )
    np.copyto(order.view(np.uint32), keys, casting="unsafe")  # the low 32 bits, which are the index
    isects = Intersections(offsets, *listed)
    cursors = np.zeros((workers, columns * rows), np.int64)
    parallel_for(workers, count_tiles, order, boxes, columns, cursors)
    longest = running_starts(cursors, isects.isect_offsets)
    parallel_for(workers, scatter_tiles, order, boxes, columns, cursors, isects)
    return isects, int(longest)


def blending_workers(workers: int, isects: Intersections, longest: int) -> int:
    """Return how many workers should blend: so many that their memory, for a list of the ``longest`` length each, is
    not more than for all intersections."""
    return min(workers, max(1, -(-len(isects.flatten_ids) // max(1, longest))))


@compiled
def list_visible(boxes: Array, depth_bits: Array, keys: Array, gaussian_offsets: Array) -> int:
    """Write each visible Gaussian's sort key (depth, then index) to ``keys``, and the running sum of how many tiles
    Gaussians touch to ``gaussian_offsets`` [N + 1]. Return the number of visible ones."""
    shown, isect = 0, 0
    for i in range(boxes.shape[0]):
        gaussian_offsets[i] = isect
        tiles = (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        if tiles > 0:
            # depths are positive, so their bits have the same order
            keys[shown] = np.uint64(depth_bits[i]) << np.uint64(32) | np.uint64(i)
            shown += 1
            isect += tiles
    gaussian_offsets[boxes.shape[0]] = isect
    return shown


@parallel_kernel
def count_tiles(worker: int, workers: int, order: Array, boxes: Array, columns: int, counts: Array) -> None:
    """Count each tile in the ``boxes`` of the worker's part of ``order``; ``counts`` int64 [workers, tiles]."""
    first, end = chunk_range(worker, workers, order.shape[0])
    for k in range(first, end):
        i = order[k]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                counts[worker, row * columns + column] += 1


@compiled
def running_starts(counts: Array, starts: Array) -> Any:
    """Replace ``counts`` [workers, tiles] by the index where each worker begins to write in each tile's list, and fill
    ``starts`` [tiles + 1] with where the lists begin. Return the length of the longest list."""
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
    worker: int, workers: int, order: Array, boxes: Array, columns: int, cursors: Array, out: Intersections
) -> None:
    """Write the worker's part of ``order`` to the tiles' lists, ``flatten_ids`` and ``isect_ids`` of ``out``."""
    first, end = chunk_range(worker, workers, order.shape[0])
    for k in range(first, end):
        i = order[k]
        isect = out.gaussian_offsets[i]
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * columns + column
                index = cursors[worker, tile]
                cursors[worker, tile] = index + 1
                out.flatten_ids[index] = i
                out.isect_ids[index] = isect
                isect += 1
