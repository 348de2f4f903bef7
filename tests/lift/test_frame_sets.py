"""Which frames a lift trains on: chosen once, then those that the checkpoint names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.job import Checkpoint, EventWriter, LiftRequest, StopSignal, last_run
from engine.job.system import MainMemory
from engine.lift import frame_sets
from engine.lift.frame_sets import sets_of_frames
from engine.scene import Scene, open_scene
from engine.train.progress import StageProgress
from tests.tiny_scene import write_tiny_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_tiny_scene(tmp_path_factory.mktemp("begun") / "scene", frames=10))


@pytest.fixture
def events(tmp_path: Path) -> Iterator[EventWriter]:
    writer = EventWriter(tmp_path / "events.jsonl")
    yield writer
    writer.close()


def chosen(scene: Scene, events: EventWriter, folder: Path, state: dict[str, object] | None, **options: int) -> Scene:
    checkpoint = None if state is None else Checkpoint(folder, state)  # type: ignore[arg-type]
    progress = StageProgress("check", events, StopSignal(folder / "cancel"))
    request = LiftRequest(scene=scene.folder, options=options)
    return sets_of_frames(scene, request, checkpoint, progress, events).chosen


def warnings(folder: Path) -> list[str]:
    return [str(event.data["message"]) for event in last_run(folder / "events.jsonl") if event.kind == "warning"]


def test_a_checkpoint_says_which_frames(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    names = [frame.name for frame in scene.train_frames[1:7:2]]
    begun = chosen(scene, events, tmp_path, {"step": 3, "frames": names}, frames=5)
    assert [frame.name for frame in begun.train_frames] == names
    assert begun.test_frames == scene.test_frames
    assert f"3 of {len(scene.train_frames)} training frames are lifted" in warnings(tmp_path)[0]


@pytest.mark.parametrize("state", [None, {"step": 3}], ids=["a new lift", "an earlier version's checkpoint"])
def test_frames_are_chosen_if_the_checkpoint_names_none(
    state: dict[str, object] | None, scene: Scene, events: EventWriter, tmp_path: Path
) -> None:
    assert len(chosen(scene, events, tmp_path, state, frames=5).train_frames) == 5
    assert chosen(scene, events, tmp_path, state, frames=0) is scene


@pytest.mark.parametrize("frames", [[], "0001", [1], None])
def test_a_checkpoint_without_names_is_refused(
    frames: object, scene: Scene, events: EventWriter, tmp_path: Path
) -> None:
    with pytest.raises(PlgsError, match="the checkpoint names no frames"):
        chosen(scene, events, tmp_path, {"frames": frames})


def test_a_missing_frame_is_named(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    held_out = scene.test_frames[0].name
    for name in ("gone", held_out):
        with pytest.raises(PlgsError, match=f"begun with frame {name}"):
            chosen(scene, events, tmp_path, {"frames": [scene.train_frames[0].name, name]})


def test_a_smaller_machine_cannot_continue(
    scene: Scene, events: EventWriter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [frame.name for frame in scene.train_frames]
    monkeypatch.setattr(frame_sets, "main_memory", lambda: MainMemory(10**7, 10**7))
    with pytest.raises(PlgsError, match=rf"begun with {len(names)} frames.*Resume it on a computer"):
        chosen(scene, events, tmp_path, {"frames": names})
    monkeypatch.setattr(frame_sets, "main_memory", lambda: MainMemory(10**12, 10**7))
    chosen(scene, events, tmp_path, {"frames": names})
    assert "only 0.0 GB are free" in warnings(tmp_path)[0]
