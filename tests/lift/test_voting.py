"""After training, the frames vote on the Gaussians' labels."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest

from engine.errors import Cancelled, PlgsError
from engine.job import EventWriter, StopSignal
from engine.job.progress import StageReporter
from engine.lift.frame_sets import frames_to_vote
from engine.lift.objects_in_view import LEAST_SHOWN, objects_in_view, with_hidden_objects
from engine.lift.preparation import PreparedLift, ViewsToLift, prepare
from engine.lift.run import STAGES
from engine.lift.voting import SMALLER, read_voters, vote_labels
from engine.model.label_voting import contributors
from engine.model.render import render_view
from engine.model.settling import OwnedPoints
from engine.model.structured import NO_OBJECT
from engine.passes.layers import decide
from engine.presets.preset import PRESETS, Preset
from engine.scene import Frame, Scene, Segment, View, load_view, open_scene
from engine.train import warm_start
from engine.train.trainer import Trainer
from tests.tiny_scene import CABINET_ID, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import TINY, prepared_for, warnings_in

LARGE, SMALL = (128, 96), (64, 48)
PRESET = replace(TINY, steps=30, vote_size=LARGE, free_space=False)  # Gaussians in the air, so that decoders smear


@pytest.fixture(scope="module")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, PreparedLift]:
    """Masks twice as large as the pictures that were trained on."""
    folder = tmp_path_factory.mktemp("voting")
    scene = open_scene(write_tiny_scene(folder / "scene", frames=8, size=LARGE), None, up="z")
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
    labels, _ = vote_labels(prepared.scene, scene.train_frames, prepared, preset, progress=progress)
    return replace(prepared, scene=replace(prepared.scene, voted=labels))


@pytest.mark.parametrize(("masks_agree", "rounds"), [(True, 2), (False, 1)])
def test_voted_labels_fit_the_masks_better(lifted: tuple[Scene, PreparedLift], masks_agree: bool, rounds: int) -> None:
    scene, prepared = lifted[0], replace(lifted[1], masks_agree=masks_agree)
    calls: list[tuple[int, int]] = []
    after = voted(scene, prepared, PRESET, lambda *count: calls.append(count))
    frames = len(scene.train_frames)
    whole = (rounds + 1) * frames  # once more to see whether every object is shown
    assert calls[:whole] == [(number, whole) for number in range(1, whole + 1)]
    before, now = shares_right(scene, prepared), shares_right(scene, after)
    assert now.of_class > before.of_class + 0.04 and now.of_object > before.of_object


def test_every_object_appears_in_the_passes_where_its_points_are(lifted: tuple[Scene, PreparedLift]) -> None:
    """A third object of a few points on the cabinet, which no mask names and so no Gaussian shows."""
    scene, prepared = lifted
    cabinet = next(one for one in prepared.instances if one.class_id == CABINET_ID)
    channels, number = prepared.scene.channels, max(one.id for one in prepared.instances) + 1
    own = np.flatnonzero(prepared.instance_of_point == cabinet.id)
    top = own[np.argsort(-prepared.cloud.xyz[own, 2])[:12]]
    instance = prepared.instance_of_point.copy()
    instance[top] = number
    slots = (*channels.slot_ids[: len(prepared.instances)], number, *channels.slot_ids[len(prepared.instances) :])
    classes = {**{one.id: one.class_id for one in prepared.instances}, number: CABINET_ID}
    wider = replace(channels, slot_ids=slots, class_of_slot=tuple(classes.get(slot, 0) for slot in slots))
    labels, _ = vote_labels(prepared.scene, scene.train_frames, prepared, PRESET, progress=lambda *_: None)
    changed = replace(prepared.scene, channels=wider)
    views = [contributors(changed, frame.camera) for frame in scene.train_frames]
    points = OwnedPoints(prepared.cloud.xyz, instance)
    before = objects_in_view(changed, labels, views, points)
    assert before.seen[-1] > 5 and before.shown[-1] == 0 and (before.share[:-1] > LEAST_SHOWN).all()
    after = objects_in_view(changed, with_hidden_objects(changed, labels, before), views, points)
    assert (after.share > LEAST_SHOWN).all() and after.numbers()["below"] == 0


def test_voting_on_labels_can_be_stopped(lifted: tuple[Scene, PreparedLift]) -> None:
    with pytest.raises(Cancelled):
        voted(*lifted, PRESET, Mock(side_effect=Cancelled("asked to")))


def test_a_lift_without_objects_still_shows_classes(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path / "scene", frames=8, size=SMALL), None, up="z")
    views = [load_view(frame) for frame in scene.train_frames]
    prepared = prepared_for(views, scene.classes, replace(TINY, most_instances=0), tmp_path)
    assert not prepared.instances and prepared.scene.channels.slot_ids[0] == NO_OBJECT
    after = voted(scene, prepared, replace(PRESET, vote_size=SMALL), lambda done, of: None)
    assert after.scene.voted is not None and int(after.scene.voted.label.max()) < len(prepared.scene.channels.class_ids)
    layers = decide(render_view(after.scene, views[0].camera), scene.classes)
    assert not layers.instance.any() and CHAIR_ID in layers.semantic


TRAINED_ON = 3
BAD = "made-up", "is not a picture", "masks/0002.png", "Mend it."
COARSE = replace(TINY, voxel_size=0.1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_tiny_scene(tmp_path_factory.mktemp("voters") / "scene", frames=10))


def trained_on(scene: Scene) -> Scene:
    return replace(scene, frames=(*scene.train_frames[::3][:TRAINED_ON], *scene.test_frames))


def voters(frames: Sequence[Frame], folder: Path) -> tuple[Sequence[View], list[str]]:
    """And the warnings."""
    events = EventWriter(folder / "events.jsonl")
    views = read_voters(frames, COARSE, lambda done: None, events, folder)
    events.close()
    return views, warnings_in(folder / "events.jsonl")


def prepared_with(scene: Scene, views: list[View], others: Sequence[View], folder: Path) -> PreparedLift:
    events = EventWriter(folder / "stages.jsonl")
    stages = StageReporter(events, StopSignal(folder / "cancel"), STAGES)
    prepared = prepare(ViewsToLift(views, scene.classes, COARSE, 0, others, folder), stages)
    events.close()
    return prepared


def called_a_cabinet(view: View) -> View:
    """What is a chair has the class of a cabinet."""

    def mistaken(segment: Segment) -> Segment:
        return replace(segment, class_id=CABINET_ID) if segment.class_id == CHAIR_ID else segment

    return replace(view, mask=replace(view.mask, segments=tuple(map(mistaken, view.mask.segments))))


def test_frames_that_are_neither_held_out_nor_trained_on_vote(scene: Scene) -> None:
    chosen = trained_on(scene)
    voting = frames_to_vote(scene, chosen, COARSE)
    assert len(voting) == len(scene.train_frames) - TRAINED_ON
    assert not {frame.name for frame in voting} & {frame.name for frame in chosen.frames}
    assert frames_to_vote(scene, scene, COARSE) == ()
    for preset in (replace(COARSE, all_frames_vote=False), PRESETS["paper"]):
        assert frames_to_vote(scene, chosen, preset) == ()


def test_extra_voting_frames_load_only_small_masks_and_depth(scene: Scene, tmp_path: Path) -> None:
    frames = [
        replace(frame, read_colour=Mock(side_effect=AssertionError("no photo is read"))) for frame in scene.train_frames
    ]
    views, told = voters(frames, tmp_path)
    assert not told and [view.name for view in views] == [frame.name for frame in frames]
    width, height = frames[0].size
    for view, frame in zip(views, frames, strict=True):
        assert view.depth.shape == view.mask.ids.shape == (height // SMALLER, width // SMALLER)
        np.testing.assert_allclose(view.camera.K, frame.camera.resized(width // SMALLER, height // SMALLER).K)
        assert set(np.unique(view.mask.ids)) <= {0, *(segment.id for segment in view.mask.segments)}


def test_an_unreadable_frame_is_reported_and_does_not_vote(scene: Scene, tmp_path: Path) -> None:
    frames = list(scene.train_frames)
    frames[1] = replace(frames[1], read_mask=Mock(side_effect=PlgsError(*BAD)))
    views, told = voters(frames, tmp_path)
    assert [view.name for view in views] == [frame.name for frame in frames if frame is not frames[1]]
    assert told == [f"1 of {len(frames)} frames that are not trained on do not vote: {PlgsError(*BAD)}"]


def test_extra_voting_frames_can_outvote_training_frames(scene: Scene, tmp_path: Path) -> None:
    chosen = trained_on(scene)
    views = [called_a_cabinet(load_view(frame)) for frame in chosen.train_frames]
    views[0] = load_view(chosen.train_frames[0])  # one tells of chairs: only classes that are known are voted for
    others, _ = voters(frames_to_vote(scene, chosen, COARSE), tmp_path)

    def classes(prepared: PreparedLift) -> list[int]:
        return sorted(one.class_id for one in prepared.instances)

    alone, together = (prepared_with(scene, views, voting, tmp_path) for voting in ((), others))
    assert classes(alone) == [CABINET_ID, CABINET_ID]
    assert classes(together) == [CABINET_ID, CHAIR_ID]
    chair = next(one for one in together.instances if one.class_id == CHAIR_ID)
    assert (together.cloud.class_id[together.instance_of_point == chair.id] == CHAIR_ID).mean() > 0.99
    # What is listed of an object is of the frames trained on; so is all that is trained on.
    names = {view.name for view in views}
    assert {mask.frame for one in together.instances for mask in one.masks} == names
    assert together.label_maps is not None and len(together.label_maps) == len(together.targets) == len(views)
