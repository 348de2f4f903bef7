"""Which frames a lift trains on: chosen once, then those that the checkpoint names."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shutil import disk_usage

import pytest

from engine.errors import ErrorCode
from engine.job import Checkpoint, EventWriter, LiftRequest, StopSignal
from engine.job.prediction import predict
from engine.job.progress import StageProgress
from engine.job.system import MainMemory
from engine.lift import frame_sets
from engine.lift.frame_sets import LEAST_PIXEL, check_disk, frames_that_fit, masks_a_frame, sets_of_frames
from engine.presets.preset import PRESETS
from engine.scene import Scene, open_scene
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import warnings_in


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


def test_a_resumed_lift_keeps_the_frames_of_its_checkpoint(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    names = [frame.name for frame in scene.train_frames[1:7:2]]
    begun = chosen(scene, events, tmp_path, {"step": 3, "frames": names}, frames=5)
    assert [frame.name for frame in begun.train_frames] == names
    assert begun.test_frames == scene.test_frames
    assert f"3 of {len(scene.train_frames)} training frames are lifted" in warnings_in(tmp_path / "events.jsonl")[0]


@pytest.mark.parametrize("state", [None, {"step": 3}], ids=["a new lift", "an earlier version's checkpoint"])
def test_frames_are_chosen_again_without_a_checkpoint(
    state: dict[str, object] | None, scene: Scene, events: EventWriter, tmp_path: Path
) -> None:
    assert len(chosen(scene, events, tmp_path, state, frames=5).train_frames) == 5
    assert chosen(scene, events, tmp_path, state, frames=0) is scene


@pytest.mark.parametrize("frames", [[], "0001", [1], None])
def test_a_checkpoint_must_name_its_frames(frames: object, scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    with raises_key("checkpoint-frames"):
        chosen(scene, events, tmp_path, {"frames": frames})


def test_a_frame_missing_since_the_lift_began_is_named(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    held_out = scene.test_frames[0].name
    for name in ("gone", held_out):
        with raises_key(f"frame-gone {name}"):
            chosen(scene, events, tmp_path, {"frames": [scene.train_frames[0].name, name]})


def test_a_lift_is_refused_if_memory_is_low(
    scene: Scene, events: EventWriter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [frame.name for frame in scene.train_frames]
    monkeypatch.setattr(frame_sets, "main_memory", lambda: MainMemory(10**7, 10**7))
    with raises_key(f"too-much {len(names)}"):
        chosen(scene, events, tmp_path, {"frames": names})
    monkeypatch.setattr(frame_sets, "main_memory", lambda: MainMemory(10**12, 10**7))
    chosen(scene, events, tmp_path, {"frames": names})
    assert "only 10.0 MB is free" in warnings_in(tmp_path / "events.jsonl")[0]


MANY = 3000
PAPER = LiftRequest(scene=Path("/room"), preset="paper", options={"frames": 0})


@pytest.fixture(scope="module")
def long_scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """As many frames as a long capture has: those of the tiny scene, again and again, as large as a phone's."""
    scene = open_scene(write_tiny_scene(tmp_path_factory.mktemp("long") / "scene", frames=4))
    large = [replace(frame, camera=frame.camera.resized(1280, 960)) for frame in scene.train_frames]
    return replace(scene, frames=tuple(large[number % len(large)] for number in range(MANY)))


def peak(scene: Scene, frames: int, preset: str = "paper") -> int:
    chosen = replace(PRESETS[preset], frames=frames)
    masks, classes = masks_a_frame(scene), len(scene.classes.categories)
    return predict(MANY, 0, (1280, 960), chosen, masks_a_frame=masks, classes=classes).peak_bytes


def test_a_lift_that_fits_into_memory_keeps_all_frames(long_scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    plenty = MainMemory(10 * peak(long_scene, 0), 10 * peak(long_scene, 0))
    assert frames_that_fit(long_scene, PAPER, plenty, events) == 0
    assert frames_that_fit(long_scene, replace(PAPER, options={"frames": 70}), plenty, events) == 70
    assert frames_that_fit(long_scene, PAPER, None, events) == 0
    assert not warnings_in(tmp_path / "events.jsonl")


def test_memory_held_by_other_programs_is_reported(long_scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    needed = peak(long_scene, 0)
    assert frames_that_fit(long_scene, PAPER, MainMemory(2 * needed, needed // 2), events) == 0
    (told,) = warnings_in(tmp_path / "events.jsonl")
    assert f"{needed / 1e9:.1f} GB" in told


def test_a_lift_too_large_for_memory_is_refused_with_options_that_fit(long_scene: Scene, events: EventWriter) -> None:
    there = peak(long_scene, 200)
    assert there < peak(long_scene, 0)
    with raises_key("too-much") as refused:
        frames_that_fit(long_scene, PAPER, MainMemory(there, there), events)
    fix = refused.value.fix
    frames = int(fix.partition("--frames ")[2].split()[0])
    assert peak(long_scene, frames) <= there and frames < MANY
    assert "--fit" in fix and "--preset" in fix


def test_the_option_fit_trains_on_fewer_frames(long_scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    there = peak(long_scene, 200)
    frames = frames_that_fit(long_scene, replace(PAPER, fit=True), MainMemory(there, there), events)
    assert 50 <= frames < MANY and peak(long_scene, frames) <= there
    assert str(frames) in warnings_in(tmp_path / "events.jsonl")[0]


def test_a_lift_far_too_large_for_memory_is_refused_despite_fit(long_scene: Scene, events: EventWriter) -> None:
    with raises_key("too-much"):
        frames_that_fit(long_scene, replace(PAPER, fit=True), MainMemory(10_000_000, 10_000_000), events)


def test_passes_that_exceed_the_disk_are_refused(events: EventWriter, tmp_path: Path) -> None:
    most = int(disk_usage(tmp_path).free / LEAST_PIXEL)
    check_disk(tmp_path / "later", [(most // 100, 1)], events)
    assert not warnings_in(tmp_path / "events.jsonl")
    with raises_key("disk-full") as caught:
        check_disk(tmp_path, [(most, 1), (most, 1)], events)
    assert caught.value.code is ErrorCode.DISK_FULL


def test_passes_that_may_fill_the_disk_give_a_warning(events: EventWriter, tmp_path: Path) -> None:
    check_disk(tmp_path, [(int(disk_usage(tmp_path).free / 8.0), 1)], events)
    (told,) = warnings_in(tmp_path / "events.jsonl")
    assert "the passes need about" in told
