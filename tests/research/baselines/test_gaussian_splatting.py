"""Plain 3D Gaussians: how they are drawn, grow and are stored."""

import numpy as np
import pytest
import torch

from engine.model.gaussians import decode
from engine.model.growing import GrowthStatistics
from engine.model.render import render_view
from engine.model.structured import LabelChannels, StructuredScene, from_tensors, to_tensors
from engine.scene import Camera
from research.baselines.gaussian_splatting import (
    SCALE,
    SCALE_RATE,
    PlainDecoders,
    PlainRules,
    clone_split_prune,
    plain_gaussians,
)

CAMERA = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
CHANNELS = LabelChannels((2, 5, 7), (1, 2, 0))
SHAPE = PlainDecoders.of_labels(3, 3).shape
RULES = PlainRules(gradient=0.5, dense_share=0.01)


def some_gaussians(count: int = 30) -> StructuredScene:
    random = np.random.default_rng(0)
    positions = random.uniform([-1, -1, 2], [1, 1, 3], (count, 3)).astype(np.float32)
    rgb = random.integers(0, 256, (count, 3)).astype(np.uint8)
    anchors = plain_gaussians(positions, np.full(count, 5), rgb, SHAPE)
    return StructuredScene(anchors, PlainDecoders(SHAPE), CHANNELS, 0.1)


def test_plain_gaussians_start_with_the_clouds_colours() -> None:
    positions, rgb = np.array([[0, 0, 2], [0.3, 0, 2]], np.float32), np.array([[255, 0, 51], [0, 0, 0]], np.uint8)
    anchors = plain_gaussians(positions, np.array([5, 0]), rgb, SHAPE)
    drawn = decode(anchors, PlainDecoders(SHAPE), CAMERA, channels=torch.tensor([1, -1]))
    torch.testing.assert_close(drawn.means, torch.from_numpy(positions))
    torch.testing.assert_close(drawn.colours, torch.from_numpy(rgb) / 255.0, atol=1e-6, rtol=0)
    torch.testing.assert_close(drawn.scales, torch.full((2, 3), 0.3))
    torch.testing.assert_close(drawn.opacities, torch.tensor([0.1, 0.1]))
    torch.testing.assert_close(drawn.labels, torch.full((2, 6), 1 / 3))
    assert drawn.cluster_loss.item() == pytest.approx(np.log(3))


def test_gaussians_are_cloned_split_or_pruned_by_size_and_opacity() -> None:
    scene = some_gaussians(5)
    scene.anchors.feature[:, SCALE] = np.log(0.01) / SCALE_RATE
    scene.anchors.feature[1, SCALE] = np.log(0.5) / SCALE_RATE
    scene.anchors.feature[[2, 3], 0] = -1.0
    statistics = GrowthStatistics.empty(scene.anchors)
    statistics.drawn += 2
    statistics.gradient[[0, 1, 2]] = 2.0
    random = np.random.default_rng(0)
    round_ = clone_split_prune(scene.anchors, statistics, RULES, extent=3.0, random=random, most=100)
    assert round_.keep.tolist() == [True, False, False, False, True]
    assert len(round_.grown) == 3, "a clone of 0, two halves of 1"
    torch.testing.assert_close(round_.grown.feature[0], scene.anchors.feature[0])
    halves = torch.exp(SCALE_RATE * round_.grown.feature[1:, SCALE])
    torch.testing.assert_close(halves, torch.full((2, 3), 0.5 / 1.6))
    assert not torch.equal(round_.grown.offset[1], round_.grown.offset[2])
    assert (round_.grown.initial_class == 0).all() and (round_.grown.level == 1).all()
    assert all(float(sums.sum()) == 0 for sums in statistics.tensors().values())


def test_stored_plain_gaussians_are_drawn_the_same() -> None:
    scene = some_gaussians()
    again = from_tensors(*to_tensors(scene))
    assert isinstance(again.decoders, PlainDecoders)
    one, two = render_view(scene, CAMERA), render_view(again, CAMERA)
    assert one.alpha.max() > 0.1 and np.array_equal(one.image, two.image)
    assert np.array_equal(one.class_coverage, two.class_coverage)
