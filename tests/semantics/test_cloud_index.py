from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from engine.semantics.cloud_index import CloudIndex


@pytest.mark.parametrize("reach", [0.04, 0.1, 0.33])
def test_nearest_is_exact_within_reach(reach: float) -> None:
    generator = np.random.default_rng(3)
    points = generator.uniform(-1, 1, (800, 3))
    queries = generator.uniform(-1.2, 1.2, (500, 3))
    distance, row = cKDTree(points).query(queries)
    found = CloudIndex(points).nearest(queries, reach)
    np.testing.assert_array_equal(found, np.where(distance <= reach, row, -1))


def test_ties_go_to_the_lower_index_and_nan_finds_nothing() -> None:
    index = CloudIndex(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]))
    queries = np.array([[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 1e30]])
    assert index.nearest(queries, 0.2).tolist() == [0, 1, -1, -1]


def test_nothing_is_near_an_empty_cloud() -> None:
    assert CloudIndex(np.zeros((0, 3))).nearest(np.zeros((2, 3)), 1.0).tolist() == [-1, -1]
