"""Lists the Gaussians of each tile, by all workers, or by one where there are few."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...machine import memory
from ...machine.threads import parallel_for
from ..arrays import Intersections
from ..records import TILE
from .radix_scatter import DIGITS, PROGRESS, SPINS, Sorting, Visible, bin_gaussians

WORTH_LISTING_TOGETHER = 1000
"""Fewer Gaussians, and intersections, than this are listed by one worker: the others would come too late."""
WORTH_SORTING_TOGETHER = 10_000
"""Fewer visible Gaussians than this are sorted by one worker: two would wait for what the other has just written."""


def isect_tiles(
    workers: int,
    boxes: NDArray[np.int32],
    depths: NDArray[np.float32],
    counts: NDArray[np.int64],
    width: int,
    height: int,
) -> tuple[Intersections, int]:
    """The intersections of a picture of so many pixels, and the length of the longest tile's list.

    ``boxes`` [N, 4] and ``depths`` [N] as in ``Projected``; ``counts`` [chunks, 2]: visible Gaussians, and tiles that
    they touch, in each chunk.
    """
    shown, count = counts.sum(axis=0).tolist()
    columns, rows = -(-width // TILE), -(-height // TILE)
    listing = workers if max(count, len(boxes)) >= WORTH_LISTING_TOGETHER else 1
    sorting = listing if shown >= WORTH_SORTING_TOGETHER else 1
    isects = Intersections(
        *memory.several(
            (len(boxes) + 1, np.int64), (columns * rows + 1, np.int64), (count, np.int32), (count, np.int32)
        )
    )
    # apart from what is kept
    room = Sorting(
        *memory.several(
            (shown, np.uint32),
            (shown, np.int32),
            (shown, np.uint32),
            (shown, np.int32),
            ((sorting, DIGITS), np.int64),
            (DIGITS + 1, np.int64),
            ((listing, columns * rows), np.int64),
        )
    )
    progress, longest = np.zeros(PROGRESS, np.int64), np.zeros(1, np.int64)
    visible = Visible(boxes, depths.view(np.uint32), counts)
    parallel_for(listing, bin_gaussians, progress, SPINS, visible, columns, room, (isects, longest))
    return isects, int(longest[0])


def blending_workers(workers: int, isects: Intersections, longest: int) -> int:
    """A worker has room for the longest list: no more of them than there are such lists to do."""
    return min(workers, max(1, -(-len(isects.flatten_ids) // max(1, longest))))
