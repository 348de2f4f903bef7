"""A lift that is moved, with its scene and without; a scene that is moved alone; masks that are edited afterwards."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from engine.command_line.main import main
from engine.errors import PlgsError
from engine.export.run import export
from engine.job import ExitCode, LiftFolder, LiftRequest
from engine.presets.preset import PRESETS
from engine.result_files import read_instances
from engine.scene_of_lift import relink, scene_of_lift
from tests.tiny_scene import CABINET_ID, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with "room" and "lift", a lift of it. Only for reading."""
    root = tmp_path_factory.mktemp("made")
    scene = write_tiny_scene(root / "room", frames=6, noise=0.1)
    with presets_as(preview=TINY):
        lift_into(root / "lift", LiftRequest(scene=scene, bake="none"))
        yield root


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a copy of the lift. What it was made in is not there meanwhile."""
    shutil.copytree(made / "lift", tmp_path / "elsewhere" / "lift")
    shutil.copytree(made / "room", tmp_path / "found")
    away = made.rename(made.with_name("away"))
    yield tmp_path / "elsewhere"
    away.rename(made)


def test_with_its_scene(place: Path) -> None:
    (place.parent / "found").rename(place / "room")
    folder = LiftFolder.open(place / "lift")
    assert folder.request.scene == place / "room"
    assert all(frame.read_colour(None).any() for frame in scene_of_lift(folder).frames)


def test_without_its_scene(place: Path) -> None:
    lift = place / "lift"
    folder = LiftFolder.open(lift)
    scene = scene_of_lift(folder)
    assert [frame.name for frame in scene.test_frames] == ["0004"] and "no photos" in scene.warnings[0]
    assert main(["bake", str(lift), "--frames", "test", "-o", str(place / "out")]) == ExitCode.FINISHED
    assert (place / "out" / "0004.exr").is_file()
    export(folder, "boxes", place / "boxes", ["all"])
    with pytest.raises(PlgsError, match=r"needs its pictures.*Find Scene"):
        scene.frames[0].read_colour(None)


def test_the_scene_is_found(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lift, found = place / "lift", place.parent / "found"
    before = (lift / "request.json").read_bytes()
    other = write_tiny_scene(place.parent / "other", frames=6, size=(80, 60))
    assert main(["bake", str(lift), "--scene", str(other)]) == ExitCode.BAD_INPUT
    assert "is another scene" in capsys.readouterr().err
    assert (lift / "request.json").read_bytes() == before
    assert relink(LiftFolder.open(lift), found).request.scene == found
    assert LiftFolder.open(lift).request.scene == found
    assert json.loads((lift / "request.json").read_text())["relative"]["scene"] == "../../found"


def test_edited_masks_are_used(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PRESETS, "preview", TINY)
    lift = relink(LiftFolder.open(place / "lift"), place.parent / "found").path
    assert main(["lift", str(lift), "--resume"]) == ExitCode.FINISHED
    assert "finished already" in capsys.readouterr().out
    before = {one.class_name for one in read_instances(lift / "result" / "instances.json")[1]}
    table = place.parent / "found" / "panoptic.json"
    content = json.loads(table.read_text())
    for entry in content["annotations"]:
        for segment in entry["segments_info"]:
            segment["category_id"] = CABINET_ID if segment["category_id"] == CHAIR_ID else segment["category_id"]
    table.write_text(json.dumps(content))
    assert main(["lift", str(lift), "--resume"]) == ExitCode.FINISHED
    after = {one.class_name for one in read_instances(lift / "result" / "instances.json")[1]}
    assert before == {"chair", "cabinet"} and after == {"cabinet"}
    told = [event["message"] for event in read_events(lift) if event["event"] == "warning"]
    assert any("trained again" in line for line in told)


def test_masks_with_the_same_objects_reuse_the_checkpoint(place: Path) -> None:
    lift = LiftFolder.open(relink(LiftFolder.open(place / "lift"), place.parent / "found").path)
    points, checkpoint = lift.result_path / "semantic_points.npz", lift.path / "checkpoint" / "trainer.safetensors"
    before, trained, told = points.read_bytes(), checkpoint.read_bytes(), len(read_events(lift.path))
    for path in sorted((place.parent / "found" / "panoptic").glob("*.png"))[::2]:
        mask = cv2.imread(str(path))
        mask[:, : mask.shape[1] // 3] = 0  # void
        cv2.imwrite(str(path), mask)
    assert main(["lift", str(lift.path), "--resume"]) == ExitCode.FINISHED
    events = read_events(lift.path)[told:]
    assert not [event for event in events if event["event"] == "progress" and event.get("stage") == "train"]
    assert not [event for event in events if event["event"] == "warning" and "again" in str(event["message"])]
    assert checkpoint.read_bytes() == trained and points.read_bytes() != before  # not a step, but other votes


def read_events(lift: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (lift / "events.jsonl").read_text().splitlines()]
