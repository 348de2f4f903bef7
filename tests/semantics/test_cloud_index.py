"""The nearest point of a cloud, for queries and for the pixels of a view."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from engine.semantics.cloud_index import CloudIndex, LabelledPoints
from tests.semantics.plane_views import SOFA, WALL, wall_view


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


def test_pixels_take_the_nearest_labelled_point_within_reach() -> None:
    view = wall_view("a", 0.0)
    points = view.camera.unproject(view.depth)
    xyz = np.array([points[5, 5], points[5, 8], points[5, 6] + [0.01, 0, 0]])
    labels = np.array([WALL, SOFA, 0], np.int32)
    found = LabelledPoints(xyz, labels).project(view.camera, view.depth, 0.1)
    # Pixels are 0.075 m apart: the unknown point at column 6 is passed over, column 7 is nearer to the sofa.
    assert found[5, 4:10].tolist() == [WALL, WALL, WALL, SOFA, SOFA, SOFA]
    assert found[5, 11] == 0 and found[15, 5] == 0


def test_pixels_without_depth_have_no_label() -> None:
    view = wall_view("a", 0.0)
    points = LabelledPoints(view.camera.unproject(view.depth).reshape(-1, 3), np.full(1200, WALL, np.int32))
    depth = view.depth.copy()
    depth[3, 4] = 0
    found = points.project(view.camera, depth, 0.1)
    assert found[3, 4] == 0 and (np.delete(found.reshape(-1), 3 * 40 + 4) == WALL).all()
