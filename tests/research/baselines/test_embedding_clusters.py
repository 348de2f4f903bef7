"""Contrastive embeddings become instances: their clusters are found, and a pixel is of the nearest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from engine.model.render import render_view
from engine.model.structured import NO_OBJECT, from_tensors, to_tensors
from engine.scene import ClassTable, View
from engine.train.state import restore, trainer_state
from engine.train.trainer import Trainer
from research.baselines.embedding_clusters import (
    Centres,
    classifier_of,
    cluster_centres,
    thing_embeddings,
    with_clusters,
)
from tests.research.tiny_baseline import TINY_BASELINE, trainer_of
from tests.tiny_scene import CABINET_ID, CHAIR_ID
from tests.train.tiny_lift import views_of

Input = tuple[list[View], ClassTable]
CONTRASTIVE = replace(
    TINY_BASELINE, steps=60, instances="contrastive", objects="none", labels="decoders", instance_slots=0, label_every=1
)
CLUSTERED = 1500


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("research.baselines.embedding_clusters.CLUSTERED", CLUSTERED)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Input:
    return views_of(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def trained(tiny: Input, tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    trainer = trainer_of(*tiny, CONTRASTIVE, tmp_path_factory.mktemp("trained"))
    while not trainer.finished:
        trainer.step()
    return trainer


def test_the_classifier_finds_the_nearest_centre() -> None:
    random = np.random.default_rng(0)
    found = Centres(random.normal(size=(6, 3)) + 3.0, np.array([1.0, 4.0, 0.5]))
    embedding = random.normal(size=(200, 3)) + 3.0
    weights = classifier_of(found)
    logits = torch.from_numpy(embedding).float() @ weights["classifier.weight"].T + weights["classifier.bias"]
    apart = np.linalg.norm((embedding[:, None] - found.centre) * found.scale, axis=2)
    assert (logits.argmax(dim=1).numpy() == apart.argmin(axis=1)).mean() > 0.99  # but for rounding
    only = classifier_of(Centres(np.zeros((0, 3)), np.ones(3)))
    assert only["classifier.weight"].shape == (1, 3) and only["classifier.bias"].shape == (1,)


def test_centres_of_clusters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("research.baselines.embedding_clusters.LEAST_SHARE", 0.1)
    random = np.random.default_rng(1)
    heaps = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 2.0, 5.2]])
    embedding = heaps[random.integers(0, 3, 600)] + random.normal(scale=0.01, size=(600, 3))
    embedding[:4] = 50.0
    found = cluster_centres(embedding)
    nearest = np.linalg.norm(found.centre[:, None] - heaps, axis=2)
    assert found.centre.shape == (3, 3) and nearest.min(axis=0).max() < 0.02, "outliers move none of them"
    assert cluster_centres(np.zeros((0, 3))).centre.shape == (0, 3)


def test_a_contrastive_embedding_separates_the_objects(tiny: Input, trained: Trainer) -> None:
    views, classes = tiny
    scene = with_clusters(trained.scene, views, classes.thing_ids, 0)
    assert scene.channels.shown_ids and scene.channels.slot_ids[-1] == NO_OBJECT
    shown_as: dict[int, list[np.ndarray]] = {CHAIR_ID: [], CABINET_ID: []}
    for view in views:
        coverage = render_view(scene, view.camera).instance_coverage
        for class_id, shown in shown_as.items():
            shown.append(coverage.argmax(axis=2)[view.mask.class_map() == class_id])
    chair, cabinet = (np.bincount(np.concatenate(each)) for each in shown_as.values())
    assert chair.argmax() != cabinet.argmax()
    assert chair.max() > 0.8 * chair.sum() and cabinet.max() > 0.8 * cabinet.sum()


def test_the_finished_model_comes_back_without_the_slow_decoder(tiny: Input, trained: Trainer) -> None:
    scene = with_clusters(trained.scene, tiny[0], tiny[1].thing_ids, 0)
    tensors, facts = to_tensors(scene)
    assert not any("slow" in name for name in tensors)
    again = from_tensors(tensors, facts)
    camera = tiny[0][0].camera
    assert np.array_equal(render_view(again, camera).instance_coverage, render_view(scene, camera).instance_coverage)


def test_a_scene_without_things(tiny: Input, trained: Trainer) -> None:
    scene = with_clusters(trained.scene, tiny[0], frozenset(), 0)
    assert scene.channels.slot_ids == (NO_OBJECT,)
    assert render_view(scene, tiny[0][0].camera).instance_coverage.shape[2] == 0


def test_embeddings_of_things(tiny: Input, trained: Trainer) -> None:
    found = thing_embeddings(trained.scene, tiny[0], tiny[1].thing_ids, 0)
    assert found.shape == (CLUSTERED, 3) and np.isfinite(found).all()
    assert np.array_equal(found, thing_embeddings(trained.scene, tiny[0], tiny[1].thing_ids, 0))


def test_the_slow_decoder_follows(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, CONTRASTIVE, tmp_path)
    decoders = trainer.scene.decoders
    before = [each.clone() for each in decoders.slow.parameters()]
    assert all(torch.equal(one, two) for one, two in zip(before, decoders.instance.parameters(), strict=True))
    trainer.step()
    for slow, fast, old in zip(decoders.slow.parameters(), decoders.instance.parameters(), before, strict=True):
        torch.testing.assert_close(slow, 0.9 * old + 0.1 * fast)
    assert any(not torch.equal(one, two) for one, two in zip(before, decoders.slow.parameters(), strict=True))


def test_a_restored_trainer_of_embeddings_continues_bit_for_bit(tiny: Input, tmp_path: Path) -> None:
    short = replace(CONTRASTIVE, steps=10)
    whole, resumed = (trainer_of(*tiny, short, tmp_path) for _ in range(2))
    for _ in range(5):
        whole.step()
    tensors, facts = trainer_state(whole)
    restore(resumed, {name: tensor.clone() for name, tensor in tensors.items()}, facts)
    assert [resumed.step().loss for _ in range(5, 10)] == [whole.step().loss for _ in range(5, 10)]
    weights = (trainer.scene.decoders.state_dict() for trainer in (whole, resumed))
    assert all(torch.equal(one, two) for one, two in zip(*(each.values() for each in weights), strict=True))
