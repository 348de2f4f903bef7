"""What an anchor starts with, and the Gaussians that are decoded of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.model.anchors import Anchors, initial_anchors, seeded_features
from engine.model.decoders import Decoders, DecoderShape
from engine.model.gaussians import decode_rows, visible_anchors
from engine.scene import Camera

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))


def some_anchors(positions: list[list[float]], features: int = 8, k: int = 4) -> Anchors:
    feature = np.random.default_rng(0).normal(size=(len(positions), features)).astype(np.float32)
    return initial_anchors(
        np.array(positions, np.float32),
        np.ones(len(positions), int),
        gaussians_per_anchor=k,
        feature=feature,
        voxel_size=0.05,
    )


def some_decoders(label_view_input: bool = False) -> Decoders:
    return Decoders(DecoderShape(8, 4, 3, 5, distance_input=True, label_view_input=label_view_input), seed=1)


def test_only_anchors_in_the_picture_are_decoded() -> None:
    anchors = some_anchors([[0, 0, 2], [0, 0, -2], [9, 0, 2], [0.2, 0.1, 3], [0, 0, 0.1]])
    assert visible_anchors(anchors, CAMERA).tolist() == [0, 3]


@pytest.mark.parametrize("label_view_input", [False, True])
def test_labels_depend_on_the_view_only_when_asked(label_view_input: bool) -> None:
    anchors, decoders = some_anchors([[0, 0, 2], [0.2, 0.1, 3]]), some_decoders(label_view_input)
    with torch.no_grad():
        decoders.opacity.get_parameter("2.bias").fill_(9.0)  # all Gaussians are drawn, whoever looks
    rows = torch.arange(2)
    first = decode_rows(anchors, decoders, rows, torch.zeros(3)).labels
    second = decode_rows(anchors, decoders, rows, torch.tensor([0.0, 5.0, 1.0])).labels
    assert torch.equal(first, second) is not label_view_input


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
