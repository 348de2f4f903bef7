"""Encodings that tell instances apart: trained on the tiny room, they separate its objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from engine.model.render import render_view
from engine.presets.preset import Schedule
from engine.scene import ClassTable, View
from engine.train.state import restore, trainer_state
from engine.train.trainer import Trainer
from research.baselines.options import BaselinePreset
from tests.research.tiny_baseline import TINY_BASELINE, trainer_of
from tests.train.tiny_lift import STEPS, views_of

Input = tuple[list[View], ClassTable]
IDENTITY = replace(TINY_BASELINE, instances="identity", labels="decoders", instance_slots=0, label_every=1)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Input:
    return views_of(tmp_path_factory.mktemp("tiny") / "scene")


def trained(tiny: Input, preset: BaselinePreset, folder: Path) -> Trainer:
    trainer = trainer_of(*tiny, preset, folder)
    while not trainer.finished:
        trainer.step()
    return trainer


def test_an_identity_encoding_separates_the_objects(tiny: Input, tmp_path: Path) -> None:
    cold = replace(IDENTITY, steps=40, warm_start=False, schedule=Schedule(self_training_every=1.0))
    trainer = trained(tiny, cold, tmp_path)
    right, total, objects = 0, 0, set()
    for number, view in enumerate(trainer.views):
        slot = trainer.target(number).slot.numpy()
        owned = np.isin(slot, trainer.scene.channels.instance_slots)
        shown = render_view(trainer.scene, view.camera).instance_coverage.argmax(axis=2)
        right += int((shown == slot)[owned].sum())
        total += int(owned.sum())
        objects |= set(slot[owned].tolist())
    assert len(objects) > 1 and right > 0.9 * total


def test_the_warm_start_fits_encoding_and_classifier(tiny: Input, tmp_path: Path) -> None:
    scene = trainer_of(*tiny, IDENTITY, tmp_path).scene
    _, logits = scene.decoders.label_logits(scene.anchors.feature, scene.anchors.feature)
    best = logits[:, 0].argmax(dim=1)
    owned = best[[slot in scene.channels.instance_slots for slot in best.tolist()]]
    assert len(owned.unique()) > 1, "anchors of several objects are told apart before the first step"


def test_a_restored_trainer_of_an_encoding_continues_bit_for_bit(tiny: Input, tmp_path: Path) -> None:
    whole, resumed = (trainer_of(*tiny, IDENTITY, tmp_path) for _ in range(2))
    for _ in range(5):
        whole.step()
    tensors, facts = trainer_state(whole)
    restore(resumed, {name: tensor.clone() for name, tensor in tensors.items()}, facts)
    assert [resumed.step().loss for _ in range(5, STEPS)] == [whole.step().loss for _ in range(5, STEPS)]
    weights = (trainer.scene.decoders.state_dict() for trainer in (whole, resumed))
    assert all(torch.equal(one, two) for one, two in zip(*(each.values() for each in weights), strict=True))


def test_losses_of_an_encoding_never_reach_opacity_or_shape(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, IDENTITY, tmp_path)
    target = trainer.target(0)
    gaussians, columns = trainer._decode(target), trainer._columns_to_draw(target)
    rendering = gaussians.drawn_by(target.camera, gaussians.labels[:, columns], want_means2d_grad=True)
    sum(trainer._label_losses(gaussians, rendering, target, columns)).backward()
    decoders, anchors = trainer.scene.decoders, trainer.scene.anchors
    for untouched in (decoders.opacity, decoders.covariance, decoders.colour):
        assert all(p.grad is None or not p.grad.any() for p in untouched.parameters())
    assert all(each is None or not each.any() for each in (anchors.offset.grad, anchors.log_scale.grad))
    for taught in (decoders.semantic, decoders.instance, decoders.classifier):
        assert all(p.grad is not None and p.grad.any() for p in taught.parameters())
