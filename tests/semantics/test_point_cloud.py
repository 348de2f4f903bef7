"""The semantic point cloud: its clusters, its labels, and its point nearest to a place or a pixel."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from engine.semantics.cloud_index import CloudIndex, LabelledPoints
from engine.semantics.clustering import lloyd_step, seed_centres
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


def test_pixels_with_rejected_labels_still_give_points() -> None:
    views = [wall_view("a", 0.0)]
    keep = [square(0, 1, slice(0, 20), slice(0, 30)).astype(bool)]
    cloud = build_point_cloud(views, keep, CLASS_IDS, OPTIONS)
    right = cloud.xyz[:, 0] > 0.3
    assert (cloud.class_id[right] == WALL).all() and (cloud.class_id[cloud.xyz[:, 0] < -0.3] == 0).all()


def test_a_point_without_a_majority_label_is_unknown() -> None:
    votes = np.array([[4.0, 3.0, 3.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 9.0]])
    class_id, share = majority_vote(votes, (3, 5, 9), 0.5)
    assert class_id.tolist() == [0, 3, 0, 9]
    np.testing.assert_allclose(share, [0.4, 0.5, 0.0, 0.9], rtol=1e-6)


def test_a_point_cloud_of_views_without_depth_is_refused() -> None:
    views = [wall_view("a", 0.0, depth=0.0)]
    with pytest.raises(ValueError, match="depth"):
        build_point_cloud(views, everything(views), CLASS_IDS, OPTIONS)


def cloud_of(xyz: np.ndarray, class_id: list[int]) -> SemanticPointCloud:
    count = len(xyz)
    return SemanticPointCloud(
        xyz.astype(np.float32), np.zeros((count, 3), np.uint8), np.array(class_id, np.int32),
        np.ones(count, np.float32), np.zeros((count, 0), np.float32), (), 0.1,
    )  # fmt: skip


def test_anchors_take_the_majority_label_of_their_voxel() -> None:
    xyz = np.array([[0.1, 0, 0], [0.2, 0, 0], [-0.1, 0, 0], [1.0, 0, 0], [1.1, 0, 0], [2.0, 0, 0]])
    cloud = cloud_of(xyz, [5, 5, 3, 6, 4, 0])
    instance = np.array([7, 8, 9, 2, 1, 4], np.int32)
    anchors = np.array([[2, 0, 0], [0, 0, 0], [1, 0, 0], [9, 0, 0]], np.float32)
    class_id, instance_id = label_anchors(cloud, instance, anchors, 1.0)
    # Voxel 0: two of three say 5, instances 7 and 8 tie. Voxel 1: a tie. Voxel 2: unknown. No voxel at 9.
    assert class_id.tolist() == [0, 5, 4, 0]
    assert instance_id.tolist() == [4, 7, 1, 0]


@pytest.mark.parametrize("reach", [0.04, 0.1, 0.33])
def test_the_nearest_point_within_reach_is_exact(reach: float) -> None:
    generator = np.random.default_rng(3)
    points = generator.uniform(-1, 1, (800, 3))
    queries = generator.uniform(-1.2, 1.2, (500, 3))
    distance, row = cKDTree(points).query(queries)
    found = CloudIndex(points).nearest(queries, reach)
    np.testing.assert_array_equal(found, np.where(distance <= reach, row, -1))


def test_equally_near_points_go_to_the_lower_index() -> None:
    index = CloudIndex(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]))
    queries = np.array([[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 1e30]])
    assert index.nearest(queries, 0.2).tolist() == [0, 1, -1, -1]


def test_pixels_take_the_label_of_the_nearest_point_in_reach() -> None:
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


CLOUD = np.random.default_rng(1).uniform(0, 1, (4000, 3)) * [1.0, 1.0, 0.05]
BATCHES = [CLOUD[:1500], CLOUD[1500:]]


def test_seed_points_are_cell_means_however_the_cloud_is_split() -> None:
    centres, spacing = seed_centres(BATCHES, 0.25, 1000)
    whole, _ = seed_centres([CLOUD], 0.25, 1000)
    assert spacing == 0.25 and len(centres) == 16
    np.testing.assert_allclose(centres, whole, atol=1e-12)
    first = CLOUD[(CLOUD < 0.25).all(1)].mean(0)
    np.testing.assert_allclose(centres[0], first, atol=1e-12)


def test_a_limit_on_points_enlarges_their_spacing() -> None:
    centres, spacing = seed_centres(BATCHES, 0.02, 100)
    assert len(centres) <= 100 and spacing > 0.02


def test_lloyd_steps_never_raise_the_error_of_seed_points() -> None:
    def error(centres: np.ndarray) -> float:
        return float(((CLOUD[:, None] - centres[None]) ** 2).sum(-1).min(1).mean())

    centres, spacing = seed_centres(BATCHES, 0.25, 1000)
    moved = lloyd_step(BATCHES, centres, spacing)
    assert error(moved) < error(centres)
