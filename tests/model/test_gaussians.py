"""Decoding anchors into Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.model.anchors import Anchors, initial_anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.model.gaussians import decode, decode_rows, visible_anchors
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


def test_gaussians_without_opacity_are_dropped_and_labels_sum_to_one() -> None:
    anchors, decoders = some_anchors([[0, 0, 2], [0.2, 0.1, 3], [-0.3, 0, 2.5]]), some_decoders()
    decoded = decode(anchors, decoders, CAMERA)
    assert (decoded.opacities > 0).all()
    assert len(decoded.opacities) == int((decoded.all_opacities > 0).sum())
    torch.testing.assert_close(decoded.labels[:, :3].sum(1), torch.ones(len(decoded.labels)))
    torch.testing.assert_close(decoded.labels[:, 3:].sum(1), torch.ones(len(decoded.labels)))


def test_equal_features_seen_from_the_same_direction_decode_alike() -> None:
    """Scaffold-GS starts all features at zero: what an anchor shows then depends on the direction alone."""
    anchors, decoders = some_anchors([[0, 0, 2], [0, 0, 3]]), some_decoders()
    decoders.shape = DecoderShape(8, 4, 3, 5, distance_input=False, label_view_input=False)
    anchors.feature = torch.zeros_like(anchors.feature)
    seen = decoders.view_input(anchors.feature, anchors.position, torch.zeros(3))
    torch.testing.assert_close(seen[0], seen[1])


@pytest.mark.parametrize("label_view_input", [False, True])
def test_labels_depend_on_the_view_only_when_asked(label_view_input: bool) -> None:
    anchors, decoders = some_anchors([[0, 0, 2], [0.2, 0.1, 3]]), some_decoders(label_view_input)
    with torch.no_grad():
        decoders.opacity.get_parameter("2.bias").fill_(9.0)  # all Gaussians are drawn, whoever looks
    rows = torch.arange(2)
    first = decode_rows(anchors, decoders, rows, torch.zeros(3)).labels
    second = decode_rows(anchors, decoders, rows, torch.tensor([0.0, 5.0, 1.0])).labels
    assert torch.equal(first, second) is not label_view_input
