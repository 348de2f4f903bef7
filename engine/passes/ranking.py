"""The kernel behind Cryptomatte's ranks: the largest coverages of every pixel, in one pass over the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, compiled, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from .deciding import FAINT, ONE, STEPS, ZERO

RANKS = 6
"""Pairs per pixel: three layers of channels with two pairs each."""
SMALLEST = 1 / 256
"""Pairs with less coverage than this are left out: no picture shows them, and noise does not compress."""
CHUNK = 4096
"""Pixels that a worker takes at once."""

_LEAST = np.float32(SMALLEST)


def rank_coverage(
    coverage: NDArray[np.float32],
    columns: Sequence[int],
    ids: NDArray[np.float32],
    alpha: NDArray[np.float32],
    limit: NDArray[np.float32] | None,
    out: NDArray[np.float32],
    first_row: int = 0,
) -> None:
    """The RANKS largest of some columns of a coverage float32 [h, W, C], as (id, coverage) pairs in descending order;
    ties go to the earlier column.

    ``ids`` float32 [L]: the id of each of the L ``columns``. ``limit`` float32 [h, W] or None: the most that a pixel's
    pairs cover together, given to the largest first. ``out`` float32 [2 RANKS, H, W], contiguous: h rows from
    ``first_row`` are written. Coverages are whole multiples of 1 / STEPS,
    and their sum is at most 1. (0, 0) follows the last pair; pixels where nothing was rendered have no pairs.
    """
    height, width, count = coverage.shape
    flat = coverage.reshape(height * width, count)
    limits = np.empty(0, np.float32) if limit is None else limit.reshape(-1)
    planes = out.reshape(2 * RANKS, -1)  # contiguous, as the kernel is compiled for one layout
    workers = worker_count()
    best = np.empty((workers, 2, RANKS), np.float32)
    wanted = np.array(columns, np.int64)
    pixels = RankedPixels(flat, alpha.reshape(-1), limits)
    parallel_for(workers, rank_pixels, pixels, wanted, ids, best, planes, first_row * width)


class RankedPixels(NamedTuple):
    """``coverage`` float32 [P, C], ``alpha`` [P], and ``limit`` [P], which is empty if there is none."""

    coverage: NDArray[np.float32]
    alpha: NDArray[np.float32]
    limit: NDArray[np.float32]


@parallel_kernel
def rank_pixels(
    worker: int, workers: int, pixels: RankedPixels, columns: Array, ids: Array, best: Array, out: Array, first: int
) -> None:
    """Rank every ``workers``-th chunk of the pixels. ``best`` float32 [workers, 2, RANKS] is scratch: ids and shares;
    ``first``: the place of the first pixel in ``out``."""
    coverage, alpha, limit = pixels.coverage, pixels.alpha, pixels.limit
    own_ids, own_shares = best[worker, 0], best[worker, 1]
    for start in range(worker * CHUNK, len(alpha), workers * CHUNK):
        for pixel in range(start, min(start + CHUNK, len(alpha))):
            total = largest_first(coverage[pixel], columns, ids, own_ids, own_shares)
            if len(limit):
                total = min(total, limit[pixel])
                fill(own_ids, own_shares, limit[pixel])
            is_shown = alpha[pixel] >= FAINT
            scale, left = STEPS / max(total, ONE), STEPS
            for rank in range(RANKS):
                steps = min(np.rint(own_shares[rank] * scale), left) if is_shown else ZERO
                left -= steps
                out[2 * rank, first + pixel] = own_ids[rank] if steps > ZERO else ZERO
                out[2 * rank + 1, first + pixel] = steps / STEPS


@compiled
def largest_first(coverage: Array, columns: Array, ids: Array, own_ids: Array, own_shares: Array) -> np.float32:
    """Insert the coverages of a pixel into the ranks, largest first; returns the sum of all that count."""
    total, last = ZERO, RANKS - 1
    for rank in range(RANKS):
        own_ids[rank] = own_shares[rank] = ZERO
    for place in range(len(columns)):
        value = coverage[columns[place]]
        if value < _LEAST:
            continue
        total += value
        if value <= own_shares[last]:
            continue
        rank = last
        while rank > 0 and own_shares[rank - 1] < value:
            own_ids[rank], own_shares[rank] = own_ids[rank - 1], own_shares[rank - 1]
            rank -= 1
        own_ids[rank], own_shares[rank] = ids[place], value
    return total


@compiled
def fill(own_ids: Array, own_shares: Array, limit: float) -> None:
    """Limit the sum of the ranks to ``limit``, the largest first."""
    left = limit
    for rank in range(RANKS):
        value = min(own_shares[rank], left)
        left -= value
        if value < _LEAST:
            own_ids[rank] = value = ZERO
        own_shares[rank] = value
