"""A lift that does not fit into memory is refused with what would make it fit, or takes fewer frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shutil import disk_usage

import pytest

from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, LiftRequest, last_run
from engine.job.prediction import predict
from engine.job.system import MainMemory
from engine.lift.frame_sets import LEAST_PIXEL, check_disk, frames_that_fit, masks_a_frame
from engine.presets.preset import PRESETS
from engine.scene import Scene, open_scene
from tests.tiny_scene import write_tiny_scene

MANY = 3000
PAPER = LiftRequest(scene=Path("/room"), preset="paper", options={"frames": 0})


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """As many frames as a long capture has: those of the tiny scene, again and again, as large as a phone's."""
    scene = open_scene(write_tiny_scene(tmp_path_factory.mktemp("long") / "scene", frames=4))
    large = [replace(frame, camera=frame.camera.resized(1280, 960)) for frame in scene.train_frames]
    return replace(scene, frames=tuple(large[number % len(large)] for number in range(MANY)))


@pytest.fixture
def events(tmp_path: Path) -> EventWriter:
    return EventWriter(tmp_path / "events.jsonl")


def peak(scene: Scene, frames: int, preset: str = "paper") -> int:
    chosen = replace(PRESETS[preset], frames=frames)
    masks, classes = masks_a_frame(scene), len(scene.classes.categories)
    return predict(MANY, 0, (1280, 960), chosen, masks_a_frame=masks, classes=classes).peak_bytes


def warnings(events: EventWriter, folder: Path) -> list[str]:
    events.close()
    return [str(event.data["message"]) for event in last_run(folder / "events.jsonl") if event.kind == "warning"]


def test_what_fits_is_lifted_as_requested(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    plenty = MainMemory(10 * peak(scene, 0), 10 * peak(scene, 0))
    assert frames_that_fit(scene, PAPER, plenty, events) == 0
    assert frames_that_fit(scene, replace(PAPER, options={"frames": 70}), plenty, events) == 70
    assert frames_that_fit(scene, PAPER, None, events) == 0
    assert not warnings(events, tmp_path)


def test_what_other_programs_hold_is_reported(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    needed = peak(scene, 0)
    assert frames_that_fit(scene, PAPER, MainMemory(2 * needed, needed // 2), events) == 0
    (told,) = warnings(events, tmp_path)
    assert f"{needed / 1e9:.1f} GB" in told


def test_what_does_not_fit_is_refused_with_the_options_that_fit(scene: Scene, events: EventWriter) -> None:
    there = peak(scene, 200)
    assert there < peak(scene, 0)
    with pytest.raises(PlgsError, match="needs about") as refused:
        frames_that_fit(scene, PAPER, MainMemory(there, there), events)
    fix = refused.value.fix
    frames = int(fix.partition("--frames ")[2].split()[0])
    assert peak(scene, frames) <= there and frames < MANY
    assert "--fit" in fix and "--preset" in fix


def test_with_consent_fewer_frames_are_used(scene: Scene, events: EventWriter, tmp_path: Path) -> None:
    there = peak(scene, 200)
    frames = frames_that_fit(scene, replace(PAPER, fit=True), MainMemory(there, there), events)
    assert 50 <= frames < MANY and peak(scene, frames) <= there
    assert str(frames) in warnings(events, tmp_path)[0]


def test_it_says_when_nothing_can_help(scene: Scene, events: EventWriter) -> None:
    with pytest.raises(PlgsError, match="more memory"):
        frames_that_fit(scene, replace(PAPER, fit=True), MainMemory(10_000_000, 10_000_000), events)


def test_passes_that_cannot_be_on_the_disk_are_refused(events: EventWriter, tmp_path: Path) -> None:
    most = int(disk_usage(tmp_path).free / LEAST_PIXEL)
    check_disk(tmp_path / "later", [(most // 100, 1)], events)
    assert not warnings(events, tmp_path)
    with pytest.raises(PlgsError, match="passes need at least .* of the disk are free") as caught:
        check_disk(tmp_path, [(most, 1), (most, 1)], events)
    assert caught.value.code is ErrorCode.DISK_FULL


def test_passes_that_may_not_be_on_the_disk_are_told(events: EventWriter, tmp_path: Path) -> None:
    check_disk(tmp_path, [(int(disk_usage(tmp_path).free / 8.0), 1)], events)
    (told,) = warnings(events, tmp_path)
    assert "the passes need about" in told
