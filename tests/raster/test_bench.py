from __future__ import annotations

import numpy as np

from engine.raster.bench import blended_pairs, measure
from engine.raster.workload import room_workload


def test_measures_every_stage() -> None:
    workload = room_workload(300, 64, 48)
    row = measure(workload, 5, 1, blended_pairs(workload))
    assert set(row["stages"]) == {"projection", "tiles", "blend", "unblend", "gather"}
    assert row["total"] >= row["forward"] > 0.0
    assert row["gflops"] > 0.0


def test_the_workload_is_always_the_same() -> None:
    first, second = room_workload(50), room_workload(50)
    assert np.array_equal(first.means, second.means) and np.array_equal(first.labels, second.labels)
    assert first.means.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(first.quats, axis=1), 1.0, atol=1e-6)
