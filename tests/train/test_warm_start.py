"""Decoders that know their anchors before the first step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model.gaussians import decode_rows
from engine.model.structured import StructuredScene
from engine.train import warm_start
from tests.train.tiny_lift import TINY, WARM_STEPS, prepared_for, views_of


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[StructuredScene]:
    """Warm, and cold; then warm in few steps from seeds 0, 0 and 1."""
    folder = tmp_path_factory.mktemp("warm")
    views, classes = views_of(folder / "scene")
    cold = replace(TINY, warm_start=False)
    chosen = ((TINY, 0, warm_start.STEPS), (cold, 0, 0), *((TINY, seed, WARM_STEPS) for seed in (0, 0, 1)))
    return [prepared_for(views, classes, preset, folder, seed, steps).scene for preset, seed, steps in chosen]


def share_right(scene: StructuredScene) -> float:
    """Share of the anchors with a known class whose every Gaussian shows that class first."""
    with torch.no_grad():
        logits, _ = scene.decoders.label_logits(scene.anchors.feature, scene.anchors.feature)
    class_ids = torch.tensor(scene.channels.class_ids)
    known = scene.anchors.initial_class > 0
    shown = class_ids[logits.argmax(dim=2)]
    return float((shown == scene.anchors.initial_class[:, None]).all(dim=1)[known].float().mean())


def test_decoders_predict_the_anchors_classes(scenes: list[StructuredScene]) -> None:
    assert share_right(scenes[0]) > 0.97
    assert share_right(scenes[1]) < 0.5


def test_the_same_seed_gives_the_same_decoders(scenes: list[StructuredScene]) -> None:
    first, again, other = (scene.decoders.state_dict() for scene in scenes[2:])
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_more_gaussians_start_visible(scenes: list[StructuredScene]) -> None:
    def visible(scene: StructuredScene) -> float:
        rows = torch.arange(len(scene.anchors))
        with torch.no_grad():
            gaussians = decode_rows(scene.anchors, scene.decoders, rows, torch.tensor([2.0, 1.5, 1.5]))
        return float(np.mean(gaussians.all_opacities.numpy() > 0))

    assert visible(scenes[0]) > visible(scenes[1])
