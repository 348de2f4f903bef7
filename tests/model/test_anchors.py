"""What an anchor starts with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.model.anchors import initial_anchors, seeded_features, spacing


def test_spacing_is_the_root_mean_square_of_three_neighbours() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    assert spacing(points)[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))


def test_selecting_keeps_all_rows_aligned() -> None:
    positions = np.arange(30, dtype=np.float32).reshape(10, 3)
    anchors = initial_anchors(
        positions,
        np.arange(10),
        gaussians_per_anchor=4,
        feature=np.repeat(np.arange(10, dtype=np.float32)[:, None], 8, axis=1),
        voxel_size=0.1,
    )
    keep = torch.arange(10) % 3 == 0
    both = anchors.select(keep).extended(anchors.select(~keep))
    for row, label in enumerate(both.initial_class.tolist()):
        assert both.position[row, 0] == positions[label, 0]
        assert both.feature[row, 0] == label


def features_of(labels: np.ndarray, features: int = 32, seed: int = 0) -> np.ndarray:
    rgb = np.zeros((len(labels), 3), np.uint8)
    return seeded_features(rgb, np.zeros_like(labels), labels, features=features, seed=seed)


def test_colour_and_labels_are_distinguished_and_unknown_is_zero() -> None:
    rgb = np.array([[0, 0, 0], [255, 255, 255]], np.uint8)
    feature = seeded_features(rgb, np.array([0, 2]), np.array([0, 1]), features=11, seed=3)
    assert feature.dtype == np.float32 and feature.shape == (2, 11)
    np.testing.assert_array_equal(feature[:, :3], [[-1] * 3, [1] * 3])
    assert not feature[0, 3:].any() and (np.abs(feature[1, 3:]) == 1).all()


def test_no_two_instances_share_a_code() -> None:
    labels = np.arange(1, 129)
    for seed in range(4):
        # 8 bits for 128 instances: drawn at will, dozens of them would be alike.
        assert len(np.unique(features_of(labels, features=18, seed=seed), axis=0)) == len(labels)


def test_more_labels_than_codes_still_end() -> None:
    assert len(np.unique(features_of(np.arange(1, 10), features=5), axis=0)) == 2
