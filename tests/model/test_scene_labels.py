"""Labels decoded once for all frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model import scene_labels as subject
from engine.model.anchors import initial_anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.model.render import render_view
from engine.model.scene_labels import scene_labels
from engine.model.structured import LabelChannels, StructuredScene
from engine.scene import Camera

CAMERA = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
SHAPE = DecoderShape(8, 4, 3, 5, distance_input=False, label_view_input=False)


def some_scene(slot_ids: tuple[int, ...], shape: DecoderShape = SHAPE) -> StructuredScene:
    random = np.random.default_rng(0)
    positions = random.uniform([-1, -1, 1.5], [1, 1, 3], (80, 3)).astype(np.float32)
    feature = random.normal(size=(80, 8)).astype(np.float32)
    anchors = initial_anchors(positions, np.ones(80, int), gaussians_per_anchor=4, feature=feature, voxel_size=0.1)
    return StructuredScene(anchors, Decoders(shape, 3), LabelChannels((2, 5, 7), slot_ids), 0.1)


@pytest.mark.parametrize("slot_ids", [(4, 9, 0, 0, 0), (0, 4, 0, 9, 0), (0, 0, 0, 0, 0), (1, 2, 3, 4, 5)])
@pytest.mark.parametrize("kernels", ["vector", "plain"])
def test_a_view_is_the_same_with_and_without(
    slot_ids: tuple[int, ...], kernels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLGS_RASTER_KERNELS", kernels)
    monkeypatch.setattr(subject, "CHUNK", 33)
    scene = some_scene(slot_ids)
    labels = scene_labels(scene)
    assert labels is not None
    with_labels, without = render_view(scene, CAMERA, labels), render_view(scene, CAMERA)
    assert without.alpha.max() > 0.3
    assert with_labels.instance_ids == without.instance_ids == tuple(slot for slot in slot_ids if slot)
    for layer in ("image", "alpha", "depth"):
        assert np.array_equal(getattr(with_labels, layer), getattr(without, layer))
    for layer in ("class_coverage", "instance_coverage"):
        np.testing.assert_allclose(getattr(with_labels, layer), getattr(without, layer), atol=1e-5)
    assert without.class_coverage.shape == (30, 40, 3)
    np.testing.assert_allclose(without.class_coverage.sum(axis=2), without.alpha, atol=1e-5)


def test_labels_that_depend_on_the_view_are_not_kept() -> None:
    assert scene_labels(some_scene((1, 0, 0, 0, 0), replace(SHAPE, label_view_input=True))) is None


def test_too_many_labels_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = some_scene((1, 0, 0, 0, 0))
    monkeypatch.setattr(subject, "MOST_BYTES", 80 * 4 * 4 * 4)
    assert scene_labels(scene) is not None
    monkeypatch.setattr(subject, "MOST_BYTES", 80 * 4 * 4 * 4 - 1)
    assert scene_labels(scene) is None


def test_probabilities_sum_to_one() -> None:
    labels = scene_labels(some_scene((1, 2, 3, 4, 5)))
    assert labels is not None
    torch.testing.assert_close(labels.probabilities[:, :3].sum(dim=1), torch.ones(320))
    torch.testing.assert_close(labels.probabilities[:, 3:].sum(dim=1), torch.ones(320))
