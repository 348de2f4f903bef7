"""Baselines and ablations train: each by its options, on the tiny room."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from engine.model.structured import NO_OBJECT
from engine.scene import ClassTable, View
from engine.train.label_losses import ThingSegments
from engine.train.state import restore, trainer_state
from research.baselines.gaussian_splatting import PlainRules
from research.baselines.method import SplattingTrainer, segment_targets
from research.baselines.options import BaselinePreset
from tests.research.tiny_baseline import TINY_BASELINE as TINY
from tests.research.tiny_baseline import prepared_for, trainer_of
from tests.train.tiny_lift import STEPS, TinyTrainer, colour_error, views_of

Input = tuple[list[View], ClassTable]
ALONE = replace(
    TINY,
    objects="none",
    one_class_an_object=False,
    linear_assignment=True,
    semantic_targets="masks",
    label_every=1,
    weights=replace(TINY.weights, cluster=0.0, depth=0.0),
)
PLAIN = replace(ALONE, representation="plain")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Input:
    return views_of(tmp_path_factory.mktemp("tiny") / "scene", noise=0.1)


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let 3DGS grow as early as the tiny lift does, whatever moves."""
    monkeypatch.setattr(SplattingTrainer, "growth_schedule", TinyTrainer.growth_schedule)
    monkeypatch.setattr(SplattingTrainer, "rules", PlainRules(gradient=1e-6))


@pytest.mark.usefixtures("often")
def test_training_plain_gaussians_lowers_the_loss_and_adds_gaussians(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, replace(PLAIN, steps=30), tmp_path)
    before, began_with = colour_error(tiny[0], trainer), len(trainer.scene.anchors)
    reports = []
    while not trainer.finished:
        reports.append(trainer.step())
    assert colour_error(tiny[0], trainer) < before and len(trainer.scene.anchors) > began_with
    epoch = len(tiny[0])
    assert sum(one.semantic for one in reports[-epoch:]) < 0.8 * sum(one.semantic for one in reports[:epoch])


@pytest.mark.usefixtures("often")
def test_a_restored_trainer_of_plain_gaussians_continues_bit_for_bit(tiny: Input, tmp_path: Path) -> None:
    whole, resumed = (trainer_of(*tiny, PLAIN, tmp_path) for _ in range(2))
    for _ in range(5):
        whole.step()
    tensors, facts = trainer_state(whole)
    restore(resumed, {name: tensor.clone() for name, tensor in tensors.items()}, facts)
    assert [resumed.step().loss for _ in range(5, STEPS)] == [whole.step().loss for _ in range(5, STEPS)]


def targets_with(tiny: Input, folder: Path, **changed: object) -> list[np.ndarray]:
    trainer = trainer_of(*tiny, replace(ALONE, **changed), folder)  # type: ignore[arg-type]
    return [target.projected.numpy() for target in trainer.targets]


def test_semantic_targets_come_from_the_chosen_source(tiny: Input, tmp_path: Path) -> None:
    views, _ = tiny
    masks = targets_with(tiny, tmp_path)
    assert all(np.array_equal(shown >= 0, view.mask.class_map() > 0) for shown, view in zip(masks, views, strict=True))
    assert all((shown == -1).all() for shown in targets_with(tiny, tmp_path, semantic_targets="none"))
    projected = targets_with(tiny, tmp_path, semantic_targets="projected", objects="boxes")
    assert any(not np.array_equal(one, other) for one, other in zip(projected, masks, strict=True))


def test_an_unmatched_thing_is_not_trained_as_no_object(tiny: Input, tmp_path: Path) -> None:
    views, _ = tiny
    for labelled in (True, False):
        trainer = trainer_of(*tiny, replace(ALONE, labelled_start=labelled, semantic_targets="projected"), tmp_path)
        no_object = trainer.scene.channels.slot_ids.index(NO_OBJECT)
        for view, target in zip(views, trainer.targets, strict=True):
            things = [one.id for one in view.mask.segments if one.is_thing]
            assert things and not (target.slot.numpy()[np.isin(view.mask.ids, things)] == no_object).any()


def loss_of(tiny: Input, folder: Path, preset: BaselinePreset) -> tuple[float, float]:
    report = trainer_of(*tiny, preset, folder).step()
    return report.semantic, report.instance


def test_each_label_loss_term_can_be_switched_off(tiny: Input, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = replace(TINY, objects="boxes", one_class_an_object=False, linear_assignment=True, label_every=1)
    semantic, instance = loss_of(tiny, tmp_path, boxes)
    without = replace(boxes, weights=replace(boxes.weights, cluster=0.0))
    assert loss_of(tiny, tmp_path, without)[0] < semantic
    consistent = replace(boxes, segment_consistency=True)
    assert loss_of(tiny, tmp_path, consistent)[0] == semantic, "classes are learned first"
    monkeypatch.setattr("research.baselines.method.FROM", 0.0)
    assert loss_of(tiny, tmp_path, consistent)[0] > semantic
    assert loss_of(tiny, tmp_path, replace(boxes, linear_assignment=False))[1] < instance


def test_an_unlabelled_start_encodes_only_colours(tiny: Input, tmp_path: Path) -> None:
    labelled, bare = (
        prepared_for(*tiny, replace(TINY, labelled_start=known), tmp_path).scene for known in (True, False)
    )
    assert (labelled.anchors.initial_class > 0).any() and not (bare.anchors.initial_class > 0).any()
    assert bare.anchors.feature[:, :3].any() and not bare.anchors.feature[:, 3:].any(), "colours, no labels"
    assert labelled.anchors.feature[:, 3:].any()


def test_a_segment_takes_its_most_certain_class() -> None:
    ids = np.array([[3, 3, 3, 0], [9, 9, 9, 9]])
    shown = np.zeros((2, 4, 3), np.float32)
    shown[0] = [[0.6, 0.4, 0.1], [0.6, 0.4, 0.1], [0.01, 0.99, 0.1], [1.0, 0.0, 0.1]]  # twice class 0, but unsurely
    shown[1] = [0.7, 0.3, 0.0]
    targets = segment_targets(torch.from_numpy(0.5 * shown), torch.full((2, 4), 0.5), 2, ThingSegments.of(ids))
    assert targets.dtype == torch.int16
    assert targets.tolist() == [[1, 1, 1, -1], [0, 0, 0, 0]]
