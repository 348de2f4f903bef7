"""The semantic point cloud, and the labels that anchors take from it."""

from __future__ import annotations

import numpy as np
import pytest

from engine.semantics.point_cloud import (
    CloudOptions,
    SemanticPointCloud,
    build_point_cloud,
    label_anchors,
    majority_vote,
)
from tests.semantics.plane_views import CLASS_IDS, SOFA, WALL, square, wall_view

OPTIONS = CloudOptions(spacing=0.2)


def everything(views: list) -> list[np.ndarray]:
    return [view.mask.ids > 0 for view in views]


def test_points_take_the_majority_of_the_views() -> None:
    views = [wall_view("a", 0.0), wall_view("b", 0.0), wall_view("c", 0.0, classes=SOFA)]
    cloud = build_point_cloud(views, everything(views), CLASS_IDS, OPTIONS)
    assert (cloud.class_id == WALL).all()
    np.testing.assert_allclose(cloud.confidence, 2 / 3, rtol=1e-6)
    np.testing.assert_allclose(cloud.xyz[:, 1], 3.0, atol=1e-5)
    assert (cloud.rgb == 128).all()


def test_rejected_pixels_give_geometry_without_a_label() -> None:
    views = [wall_view("a", 0.0)]
    keep = [square(0, 1, slice(0, 20), slice(0, 30)).astype(bool)]
    cloud = build_point_cloud(views, keep, CLASS_IDS, OPTIONS)
    right = cloud.xyz[:, 0] > 0.3
    assert (cloud.class_id[right] == WALL).all() and (cloud.class_id[cloud.xyz[:, 0] < -0.3] == 0).all()


def test_point_without_majority_is_unknown_and_ties_go_to_the_lower_id() -> None:
    votes = np.array([[4.0, 3.0, 3.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 9.0]])
    class_id, share = majority_vote(votes, (3, 5, 9), 0.5)
    assert class_id.tolist() == [0, 3, 0, 9]
    np.testing.assert_allclose(share, [0.4, 0.5, 0.0, 0.9], rtol=1e-6)


def test_views_without_depth_are_refused() -> None:
    views = [wall_view("a", 0.0, depth=0.0)]
    with pytest.raises(ValueError, match="depth"):
        build_point_cloud(views, everything(views), CLASS_IDS, OPTIONS)


def test_large_room_has_dense_points_where_labels_change() -> None:
    """A wall, its right half of another class, and a fifth of the points that it would have."""
    views = [wall_view(name, 0.0, classes=square(SOFA, WALL, slice(20, 40), slice(0, 30))) for name in ("a", "b")]
    even = build_point_cloud(views, everything(views), CLASS_IDS, CloudOptions(spacing=0.075, cap=10_000))
    cap = len(even) // 5
    cloud = build_point_cloud(views, everything(views), CLASS_IDS, CloudOptions(spacing=0.075, cap=cap))
    assert len(cloud) <= cap and cloud.spacing > 2 * 0.075
    at_edge, elsewhere = np.abs(cloud.xyz[:, 0]) < 0.15, np.abs(cloud.xyz[:, 0]) > 0.6
    width = float(np.ptp(even.xyz[:, 0]))
    assert at_edge.sum() / 0.3 > 2 * elsewhere.sum() / (width - 1.2)
    one_class = [wall_view(name, 0.0) for name in ("a", "b")]
    flat = build_point_cloud(one_class, everything(one_class), CLASS_IDS, CloudOptions(spacing=0.075, cap=cap)).xyz
    near, far = np.abs(flat[:, 0]) < 0.15, np.abs(flat[:, 0]) > 0.6
    assert near.sum() / 0.3 < 1.5 * far.sum() / (width - 1.2), "without an edge the points are even"


def cloud_of(xyz: np.ndarray, class_id: list[int]) -> SemanticPointCloud:
    count = len(xyz)
    return SemanticPointCloud(
        xyz.astype(np.float32), np.zeros((count, 3), np.uint8), np.array(class_id, np.int32),
        np.ones(count, np.float32), np.zeros((count, 0), np.float32), (), 0.1,
    )  # fmt: skip


def test_anchors_take_the_majority_of_their_voxel() -> None:
    xyz = np.array([[0.1, 0, 0], [0.2, 0, 0], [-0.1, 0, 0], [1.0, 0, 0], [1.1, 0, 0], [2.0, 0, 0]])
    cloud = cloud_of(xyz, [5, 5, 3, 6, 4, 0])
    instance = np.array([7, 8, 9, 2, 1, 4], np.int32)
    anchors = np.array([[2, 0, 0], [0, 0, 0], [1, 0, 0], [9, 0, 0]], np.float32)
    class_id, instance_id = label_anchors(cloud, instance, anchors, 1.0)
    # Voxel 0: two of three say 5, instances 7 and 8 tie. Voxel 1: a tie. Voxel 2: unknown. No voxel at 9.
    assert class_id.tolist() == [0, 5, 4, 0]
    assert instance_id.tolist() == [4, 7, 1, 0]
