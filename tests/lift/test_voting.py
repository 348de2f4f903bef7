"""After training, the frames vote on the Gaussians' labels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from engine.errors import Cancelled
from engine.lift.preparation import PreparedLift
from engine.lift.voting import vote_labels
from engine.model.render import render_view
from engine.model.settling import OwnedPoints
from engine.model.structured import NO_OBJECT
from engine.passes.layers import decide
from engine.presets.preset import Preset
from engine.scene import Scene, load_view, open_scene
from engine.train import warm_start
from engine.train.trainer import Trainer
from tests.tiny_scene import CABINET_ID, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import TINY, prepared_for

LARGE, SMALL = (128, 96), (64, 48)
PRESET = replace(TINY, steps=30, vote_size=LARGE)


@pytest.fixture(scope="module")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, PreparedLift]:
    """Masks twice as large as the pictures that were trained on."""
    folder = tmp_path_factory.mktemp("voting")
    scene = open_scene(write_tiny_scene(folder / "scene", frames=8, size=LARGE), None, "z")
    views = [load_view(frame, SMALL) for frame in scene.train_frames]
    prepared = prepared_for(views, scene.classes, PRESET, folder, warm_steps=warm_start.STEPS)
    trainer = Trainer(prepared.scene, prepared.targets, views, PRESET, 0)
    while not trainer.finished:
        trainer.step()
    return scene, replace(prepared, scene=trainer.scene)


class Right(NamedTuple):
    """Share of the pixels that show their class, and of the things' pixels that show their object."""

    of_class: float
    of_object: float


def shares_right(scene: Scene, prepared: PreparedLift) -> Right:
    instance_classes = {one.id: one.class_id for one in prepared.instances}
    of_class = {class_id: number for number, class_id in instance_classes.items()}
    right, owned = [], []
    for frame in scene.train_frames:
        layers = decide(render_view(prepared.scene, frame.camera), scene.classes, instance_classes)
        true = frame.read_mask(None).class_map()
        right.append((layers.semantic == true).mean())
        for class_id in (CHAIR_ID, CABINET_ID):
            owned.append((layers.instance[true == class_id] == of_class[class_id]).mean())
    return Right(float(np.mean(right)), float(np.mean(owned)))


def voted(scene: Scene, prepared: PreparedLift, preset: Preset, progress: Callable[[int, int], None]) -> PreparedLift:
    assert prepared.label_maps is not None
    points = OwnedPoints(prepared.cloud.xyz, prepared.instance_of_point)
    labels = vote_labels(prepared.scene, scene.train_frames, prepared.label_maps, preset, progress, points)
    return replace(prepared, scene=replace(prepared.scene, voted=labels))


@pytest.mark.parametrize("rounds", [1, 2])
def test_voted_labels_are_closer_to_the_masks(lifted: tuple[Scene, PreparedLift], rounds: int) -> None:
    scene, prepared = lifted
    calls: list[tuple[int, int]] = []
    after = voted(scene, prepared, replace(PRESET, vote_rounds=rounds), lambda *count: calls.append(count))
    frames = len(scene.train_frames)
    assert calls == [(number, rounds * frames) for number in range(1, rounds * frames + 1)]
    before, now = shares_right(scene, prepared), shares_right(scene, after)
    assert now.of_class > before.of_class + 0.04 and now.of_object > before.of_object


def test_a_vote_can_be_stopped(lifted: tuple[Scene, PreparedLift]) -> None:
    def stop(done: int, of: int) -> None:
        raise Cancelled("asked to")

    with pytest.raises(Cancelled):
        voted(*lifted, PRESET, stop)


def test_without_objects_there_are_classes(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "scene", frames=8, size=SMALL), None, "z")
    views = [load_view(frame) for frame in scene.train_frames]
    prepared = prepared_for(views, scene.classes, replace(TINY, most_instances=0), tmp_path)
    assert not prepared.instances and prepared.scene.channels.slot_ids[0] == NO_OBJECT
    after = voted(scene, prepared, replace(PRESET, vote_size=SMALL), lambda done, of: None)
    assert after.scene.voted is not None and int(after.scene.voted.label.max()) < len(prepared.scene.channels.class_ids)
    layers = decide(render_view(after.scene, views[0].camera), scene.classes)
    assert not layers.instance.any() and CHAIR_ID in layers.semantic
