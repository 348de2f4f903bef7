from __future__ import annotations

import numpy as np

from engine.semantics.cloud_index import LabelledPoints
from tests.semantics.plane_views import SOFA, WALL, wall_view


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


def test_a_cloud_without_labels_projects_nothing() -> None:
    view = wall_view("a", 0.0)
    points = LabelledPoints(np.zeros((3, 3)), np.zeros(3, np.int32))
    assert not points.project(view.camera, view.depth, 10.0).any()
