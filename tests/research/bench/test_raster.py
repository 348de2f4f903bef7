from __future__ import annotations

import numpy as np
import pytest

from research.bench.raster import blended_pairs, measure
from research.bench.room import room_workload


def test_it_measures_every_stage() -> None:
    workload = room_workload(300, 64, 48)
    pairs = blended_pairs(workload)
    row = measure(workload, 5, 1, pairs)
    assert set(row["stages"]) == {"projection", "binning", "blend forward", "blend backward", "gather"}
    assert row["total"] == pytest.approx(row["forward"] + row["backward"])
    assert sum(row["stages"].values()) <= row["total"]
    blending = row["stages"]["blend forward"] + row["stages"]["blend backward"]
    assert row["gflops"] == pytest.approx(4.0 * 5 * pairs / (blending * 1e6))


def test_the_workload_is_always_the_same() -> None:
    first, second = room_workload(50), room_workload(50)
    assert np.array_equal(first.means, second.means) and np.array_equal(first.labels, second.labels)
    assert first.means.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(first.quats, axis=1), 1.0, atol=1e-6)
