"""Frames that are not trained on vote with their masks, and with nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.errors import PlgsError
from engine.job import EventWriter, StopSignal, last_run
from engine.lift.frame_sets import frames_to_vote
from engine.lift.preparation import PreparedLift, prepare
from engine.lift.run import STAGES
from engine.lift.voting import SMALLER, read_voters
from engine.presets.preset import PRESETS
from engine.scene import Frame, PanopticMask, Scene, Segment, Size, View, load_view, open_scene
from engine.train.progress import StageReporter
from tests.tiny_scene import CABINET_ID, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import TINY

TRAINED_ON = 3
BAD = "is not a picture", "masks/0002.png", "Mend it."
PRESET = replace(TINY, voxel_size=0.1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_tiny_scene(tmp_path_factory.mktemp("voters") / "scene", frames=10))


def trained_on(scene: Scene) -> Scene:
    return replace(scene, frames=(*scene.train_frames[::3][:TRAINED_ON], *scene.test_frames))


def voters(frames: Sequence[Frame], folder: Path) -> tuple[Sequence[View], list[str]]:
    """And the warnings."""
    events = EventWriter(folder / "events.jsonl")
    views = read_voters(frames, PRESET, lambda done: None, events, folder)
    events.close()
    return views, [str(event.data["message"]) for event in last_run(folder / "events.jsonl") if event.kind == "warning"]


def prepared_with(scene: Scene, views: list[View], others: Sequence[View], folder: Path) -> PreparedLift:
    events = EventWriter(folder / "stages.jsonl")
    stages = StageReporter(events, StopSignal(folder / "cancel"), STAGES)
    prepared = prepare(views, scene.classes, PRESET, 0, stages, folder, others)
    events.close()
    return prepared


def called_a_cabinet(view: View) -> View:
    """What is a chair has the class of a cabinet."""

    def mistaken(segment: Segment) -> Segment:
        return replace(segment, class_id=CABINET_ID) if segment.class_id == CHAIR_ID else segment

    return replace(view, mask=replace(view.mask, segments=tuple(map(mistaken, view.mask.segments))))


def test_all_frames_vote_that_are_neither_held_out_nor_trained_on(scene: Scene) -> None:
    chosen = trained_on(scene)
    voting = frames_to_vote(scene, chosen, PRESET)
    assert len(voting) == len(scene.train_frames) - TRAINED_ON
    assert not {frame.name for frame in voting} & {frame.name for frame in chosen.frames}
    assert frames_to_vote(scene, scene, PRESET) == ()
    for preset in (replace(PRESET, all_frames_vote=False), PRESETS["paper"]):
        assert frames_to_vote(scene, chosen, preset) == ()


def test_they_are_small_and_contain_only_masks_and_depth(scene: Scene, tmp_path: Path) -> None:
    def nobody(size: Size | None) -> np.ndarray:
        raise AssertionError("no photo is read")

    frames = [replace(frame, read_colour=nobody) for frame in scene.train_frames]
    views, told = voters(frames, tmp_path)
    assert not told and [view.name for view in views] == [frame.name for frame in frames]
    width, height = frames[0].size
    for view, frame in zip(views, frames, strict=True):
        assert view.depth.shape == view.mask.ids.shape == (height // SMALLER, width // SMALLER)
        np.testing.assert_allclose(view.camera.K, frame.camera.resized(width // SMALLER, height // SMALLER).K)
        assert set(np.unique(view.mask.ids)) <= {0, *(segment.id for segment in view.mask.segments)}


def test_a_frame_that_cannot_be_read_does_not_vote_and_is_reported(scene: Scene, tmp_path: Path) -> None:
    def bad(size: Size | None) -> PanopticMask:
        raise PlgsError(*BAD)

    frames = list(scene.train_frames)
    frames[1] = replace(frames[1], read_mask=bad)
    views, told = voters(frames, tmp_path)
    assert [view.name for view in views] == [frame.name for frame in frames if frame is not frames[1]]
    assert told == [f"1 of {len(frames)} frames that are not trained on do not vote: {PlgsError(*BAD)}"]


def test_they_outvote_the_frames_trained_on(scene: Scene, tmp_path: Path) -> None:
    chosen = trained_on(scene)
    views = [called_a_cabinet(load_view(frame)) for frame in chosen.train_frames]
    views[0] = load_view(chosen.train_frames[0])  # one tells of chairs: only classes that are known are voted for
    others, _ = voters(frames_to_vote(scene, chosen, PRESET), tmp_path)

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
