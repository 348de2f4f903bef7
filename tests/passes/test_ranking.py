"""The largest coverages of a pixel: against a full sort, pixel by pixel."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.passes.cryptomatte import RANKS, SMALLEST, rank_coverage
from engine.passes.layers import STEPS


def sorted_pairs(shares: np.ndarray, ids: np.ndarray, limit: float | None) -> list[tuple[float, float]]:
    """The pairs of one pixel, as the docstring of ``rank_coverage`` has them."""
    counted = [(float(share), float(one)) for share, one in zip(shares, ids, strict=True) if share >= SMALLEST]
    ordered = sorted(counted, key=lambda pair: -pair[0])  # stable: ties to the earlier
    total = sum(share for share, _ in ordered)
    if limit is not None:
        total, left, filled = min(total, limit), limit, []
        for share, one in ordered:
            filled.append((min(share, left), one))
            left -= filled[-1][0]
        ordered = [pair for pair in filled if pair[0] >= SMALLEST]
    pairs = [(one, share / max(total, 1.0)) for share, one in ordered[:RANKS]]
    return pairs + [(0.0, 0.0)] * (RANKS - len(pairs))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_is_that_of_a_full_sort(seed: int) -> None:
    random = np.random.default_rng(seed)
    height, width, count = 3, 5, int(random.integers(1, 20))
    coverage = random.choice(np.array([0, 1e-3, 0.05, 0.1, 0.2, 0.6], np.float32), (height, width, count))
    columns = random.permutation(count)[: int(random.integers(0, count + 1))].tolist()
    ids = random.uniform(1, 2, len(columns)).astype(np.float32)
    alpha = random.choice(np.array([0, 1], np.float32), (height, width))
    limit = random.uniform(0, 1, (height, width)).astype(np.float32) if seed % 2 else None
    out = np.full((2 * RANKS, height, width), np.nan, np.float32)
    rank_coverage(coverage, columns, ids, alpha, limit, out)
    for pixel in np.ndindex(height, width):
        expected = np.zeros((RANKS, 2))
        if alpha[pixel]:
            expected[:] = sorted_pairs(coverage[pixel][columns], ids, None if limit is None else float(limit[pixel]))
        np.testing.assert_allclose(out[(slice(None), *pixel)].reshape(RANKS, 2), expected, atol=RANKS / 2 / STEPS)
    below = np.full((2 * RANKS, height + 2, width), np.nan, np.float32)
    rank_coverage(coverage, columns, ids, alpha, limit, below, first_row=2)
    assert (below[:, 2:] == out).all() and np.isnan(below[:, :2]).all()
    shares = out[1::2]
    assert (np.diff(shares, axis=0) <= 0).all() and shares.sum(axis=0).max() <= 1 + 1e-5


def test_the_number_of_threads_changes_no_bit() -> None:
    import torch

    random = np.random.default_rng(0)
    coverage = random.uniform(0, 0.2, (97, 101, 12)).astype(np.float32)
    alpha, threads, seen = np.ones((97, 101), np.float32), torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            out = np.empty((2 * RANKS, 97, 101), np.float32)
            rank_coverage(coverage, range(12), np.arange(1, 13, dtype=np.float32), alpha, None, out)
            seen.append(out.tobytes())
    finally:
        torch.set_num_threads(threads)
    assert seen[0] == seen[1] == seen[2]
