from __future__ import annotations

import numpy as np

from engine.semantics.point_cloud import SemanticPointCloud, label_anchors, voxelise


def cloud_of(xyz: np.ndarray, class_id: list[int]) -> SemanticPointCloud:
    count = len(xyz)
    return SemanticPointCloud(
        xyz.astype(np.float32), np.zeros((count, 3), np.uint8), np.array(class_id, np.int32),
        np.ones(count, np.float32), np.zeros((count, 0), np.float32), (), 0.1,
    )  # fmt: skip


def test_voxelisation_rounds_half_to_even_and_removes_duplicates() -> None:
    points = np.array([[0.5, 1.5, 2.5], [0.49, 1.9, 2.1], [-0.5, 0.0, 0.0], [-0.2, 0.3, 0.0]])
    np.testing.assert_array_equal(voxelise(points, 1.0), [[0, 0, 0], [0, 2, 2]])
    np.testing.assert_allclose(voxelise(points * 0.02, 0.02), np.array([[0, 0, 0], [0, 2, 2]]) * 0.02, rtol=1e-6)


def test_negative_zero_is_not_a_second_voxel() -> None:
    assert len(voxelise(np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), 1.0)) == 1


def test_anchors_take_the_majority_of_their_voxel() -> None:
    xyz = np.array([[0.1, 0, 0], [0.2, 0, 0], [-0.1, 0, 0], [1.0, 0, 0], [1.1, 0, 0], [2.0, 0, 0]])
    cloud = cloud_of(xyz, [5, 5, 3, 6, 4, 0])
    instance = np.array([7, 8, 9, 2, 1, 4], np.int32)
    anchors = np.array([[2, 0, 0], [0, 0, 0], [1, 0, 0], [9, 0, 0]], np.float32)
    class_id, instance_id = label_anchors(cloud, instance, anchors, 1.0)
    # Voxel 0: two of three say 5, instances 7 and 8 tie. Voxel 1: a tie. Voxel 2: unknown. No voxel at 9.
    assert class_id.tolist() == [0, 5, 4, 0]
    assert instance_id.tolist() == [4, 7, 1, 0]


def test_every_voxelised_anchor_of_a_labelled_cloud_has_a_label() -> None:
    xyz = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32)
    cloud = cloud_of(xyz, [1] * 2000)
    anchors = voxelise(cloud.xyz, 0.05)
    assert (label_anchors(cloud, np.zeros(len(cloud), np.int32), anchors, 0.05)[0] == 1).all()
