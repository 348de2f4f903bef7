"""Label gradients added up by vectors, against the plain twin."""

from __future__ import annotations

import numpy as np
import pytest

from engine.raster import gather, vector_gather
from engine.raster.records import LOT, TILE

GUARD = 64
UNTOUCHED = np.float32(12345.0)


@pytest.mark.parametrize("channels", [1, 2, 5, 7, 8, 15, 16, 17, 46])
def test_a_worker_writes_its_own_lot_and_nothing_else(channels: int) -> None:
    random = np.random.default_rng(channels)
    count = 2 * LOT + 11
    slots = np.concatenate([[0], np.cumsum(random.integers(0, 4, count))]).astype(np.int64)
    touched = (random.random(slots[-1]) < 0.7).astype(np.uint8)
    slot_labels = random.normal(size=slots[-1] * (-(-channels // TILE) * TILE)).astype(np.float32)
    expected = np.empty(count * channels, np.float32)
    gather.gather_labels(0, 1, np.zeros(1, np.int64), slots, touched, slot_labels, channels, expected)
    for lot in range(3):
        got = np.full(count * channels + GUARD, UNTOUCHED)
        end = min((lot + 1) * LOT, count)
        this_lot = np.array([lot])
        vector_gather.gather_labels(0, 1, this_lot, slots[: end + 1], touched, slot_labels, channels, got)
        own = slice(lot * LOT * channels, end * channels)
        np.testing.assert_array_equal(got[own], expected[own])
        assert (got[: own.start] == UNTOUCHED).all() and (got[own.stop :] == UNTOUCHED).all()
