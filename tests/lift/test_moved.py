"""A lift that is moved, with its scene and without; a scene that is moved alone; masks that are edited afterwards."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from engine.command_line.main import main
from engine.errors import Cancelled
from engine.export.run import export
from engine.job import EventWriter, ExitCode, LiftFolder, LiftRequest, LiftState, StopSignal
from engine.lift import bake_frames
from engine.presets.preset import PRESETS
from engine.result_files import read_instances
from engine.scene_of_lift import relink, scene_of_lift
from tests.raises_key import raises_key, worded
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
def home(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a copy of the lift. What it was made in is not there meanwhile."""
    shutil.copytree(made / "lift", tmp_path / "elsewhere" / "lift")
    shutil.copytree(made / "room", tmp_path / "found")
    away = made.rename(made.with_name("away"))
    yield tmp_path / "elsewhere"
    away.rename(made)


def test_a_lift_moved_with_its_scene_finds_it(home: Path) -> None:
    (home.parent / "found").rename(home / "room")
    folder = LiftFolder.open(home / "lift")
    assert folder.request.scene == home / "room"
    assert all(frame.read_colour(None).any() for frame in scene_of_lift(folder).frames)


def test_a_lift_moved_without_its_scene_can_be_baked_and_exported(home: Path) -> None:
    lift = home / "lift"
    folder = LiftFolder.open(lift)
    assert not folder.passes_path.exists(), "bake=none"
    scene = scene_of_lift(folder)
    assert [frame.name for frame in scene.test_frames] == ["0004"] and "no photos" in scene.warnings[0]
    assert main(["bake", str(lift), "--frames", "test", "-o", str(home / "out")]) == ExitCode.FINISHED
    assert (home / "out" / "0004.exr").is_file()
    export(folder, "boxes", home / "boxes", ["all"])
    with raises_key("scene-gone"):
        scene.frames[0].read_colour(None)


def test_resume_uses_new_masks(home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(PRESETS, "preview", TINY)
    lift = relink(LiftFolder.open(home / "lift"), home.parent / "found").path
    assert main(["lift", str(lift), "--resume"]) == ExitCode.FINISHED
    assert "finished already" in capsys.readouterr().out
    before = {one.class_name for one in read_instances(lift / "result" / "instances.json")[1]}
    reclass(home.parent / "found", CHAIR_ID, CABINET_ID)
    assert main(["lift", str(lift), "--resume"]) == ExitCode.FINISHED
    after = {one.class_name for one in read_instances(lift / "result" / "instances.json")[1]}
    assert before == {"chair", "cabinet"} and after == {"cabinet"}
    assert any("trained again" in line for line in warnings_of(lift))


def test_resume_with_edited_masks_of_the_same_objects_trains_no_step(home: Path) -> None:
    lift = LiftFolder.open(relink(LiftFolder.open(home / "lift"), home.parent / "found").path)
    points, checkpoint = lift.result_path / "semantic_points.npz", lift.path / "checkpoint" / "trainer.safetensors"
    before, trained, told = points.read_bytes(), checkpoint.read_bytes(), len(read_events(lift.path))
    for path in sorted((home.parent / "found" / "panoptic").glob("*.png"))[::2]:
        mask = cv2.imread(str(path))
        mask[:, : mask.shape[1] // 3] = 0  # void
        cv2.imwrite(str(path), mask)
    assert main(["lift", str(lift.path), "--resume"]) == ExitCode.FINISHED
    events = read_events(lift.path)[told:]
    assert not [event for event in events if event["event"] == "progress" and event.get("stage") == "train"]
    assert not [event for event in events if event["event"] == "warning" and "again" in str(event["message"])]
    assert checkpoint.read_bytes() == trained and points.read_bytes() != before  # not a step, but other votes


CHANGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "pose": (lambda scene: moved(scene / "pose" / "0001.txt"), "the camera of 0001 differs"),
    "photo": (lambda scene: darker(scene / "color" / "0002.png"), "the photo or the depth of 0002 differs"),
    "depth": (lambda scene: darker(scene / "depth" / "0003.png"), "the photo or the depth of 0003 differs"),
    "split": (lambda scene: split(scene, held_out="0003"), "0003 is held out"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_result_is_not_reused_for_a_changed_scene(change: str, home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    lift = relink(LiftFolder.open(home / "lift"), home.parent / "found")
    act, told = CHANGES[change]
    act(home.parent / "found")
    for ended in (lift.manifest_path, lift.events_path):  # finished, then as if killed
        assert main(["lift", str(lift.path), "--resume"]) == ExitCode.BAD_INPUT
        line = capfd.readouterr().err
        assert told in line and worded("other-scene").search(line) and "lift into another folder" in line
        ended.unlink()


def test_bake_and_export_refuse_changed_cameras(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found").path, home.parent / "found"
    moved(scene / "pose" / "0001.txt")
    for command in (["bake"], ["export", "--to", "coco", "-o", str(home / "out")]):
        assert main([command[0], str(lift), *command[1:]]) == ExitCode.BAD_INPUT
        assert "the camera of 0001 differs" in capfd.readouterr().err
    assert not (home / "out").exists()


def test_baking_all_frames_reports_a_missing_one(home: Path) -> None:
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found").path, home.parent / "found"
    (scene / "color" / "0001.png").unlink()
    assert main(["bake", str(lift), "-o", str(home / "out")]) == ExitCode.FINISHED
    assert len([*(home / "out").iterdir()]) == 5
    assert any("no longer has frame 0001" in line for line in warnings_of(lift))


def test_lifting_again_without_one_of_its_frames_is_refused(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As *Leave Out* may have it after a lift."""
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found"), home.parent / "found"
    names = [path.stem for path in sorted((scene / "color").iterdir())]
    (scene / "splits.json").write_text(json.dumps({"train": names[:1] + names[2:4] + names[5:], "test": ["0004"]}))
    assert main(["lift", str(lift.path), "--resume"]) == ExitCode.BAD_INPUT
    line = capsys.readouterr().err
    assert "the scene no longer has frame 0001" in line and "splits.json" in line
    assert lift.is_whole() and main(["bake", str(lift.path)]) == ExitCode.FINISHED


def test_changed_class_colours_do_not_lift_a_scene_again(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lift, table = relink(LiftFolder.open(home / "lift"), home.parent / "found"), home.parent / "found/panoptic.json"
    table.write_text(table.read_text().replace('"color": [210, 70, 60]', '"color": [10, 70, 60]'))
    assert main(["lift", str(lift.path), "--resume"]) == ExitCode.FINISHED
    assert "finished already" in capsys.readouterr().out


def test_a_corrected_lift_is_not_scored_against_other_photos(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found"), home.parent / "found"
    assert main(["correct", str(lift.path), "rename", "1", "Seat"]) == ExitCode.FINISHED
    darker(scene / "color" / "0001.png")  # not held out
    assert main(["evaluate", str(lift.path)]) == ExitCode.FINISHED
    darker(scene / "color" / "0004.png")
    assert main(["evaluate", str(lift.path)]) == ExitCode.BAD_INPUT
    assert "the photo or the depth of 0004 differs" in capsys.readouterr().err


def test_a_new_result_excludes_passes_of_earlier_masks(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They were listed, exported, and not baked again. What lies beside them is somebody's work."""
    monkeypatch.setitem(PRESETS, "preview", TINY)
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found"), home.parent / "found"
    assert main(["bake", str(lift.path), "--frames", "0001"]) == ExitCode.FINISHED
    view = lift.passes_path / "0001.exr"
    before = view.read_bytes()
    (lift.passes_path / "grade.blend").touch()
    reclass(scene, CHAIR_ID, CABINET_ID)
    assert main(["lift", str(lift.path), "--resume"]) == ExitCode.FINISHED
    assert not view.exists() and any("bake again" in line for line in warnings_of(lift.path))
    earlier = lift.path / "earlier" / "1" / "passes"
    assert (earlier / "0001.exr").read_bytes() == before and (earlier / "grade.blend").exists()
    assert main(["bake", str(lift.path), "--frames", "0001"]) == ExitCode.FINISHED
    assert view.read_bytes() != before


def test_a_stopped_lift_of_edited_masks_keeps_the_old_result(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PRESETS, "preview", TINY)
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found"), home.parent / "found"
    before, again = lift.manifest_path.read_bytes(), ["lift", str(lift.path), "--resume"]
    table = (scene / "panoptic.json").read_text()
    reclass(scene, CHAIR_ID, CABINET_ID)
    with monkeypatch.context() as patched:
        patched.setattr("engine.lift.run.bake_and_evaluate", Mock(side_effect=Cancelled))
        assert main(again) == ExitCode.CANCELLED
    assert lift.manifest_path.read_bytes() == before and lift.is_whole() and lift.state() is LiftState.CANCELLED
    assert main(["bake", str(lift.path), "--frames", "0001"]) == ExitCode.FINISHED
    assert lift.state() is not LiftState.FINISHED
    (scene / "panoptic.json").write_text(table)
    assert main(again) == ExitCode.FINISHED and "finished already" in capsys.readouterr().out
    assert lift.state() is LiftState.FINISHED and (lift.passes_path / "0001.exr").exists()


def test_a_bake_is_refused_while_the_scene_is_lifted_again(home: Path) -> None:
    """It would put passes of the earlier model into the new result."""
    lift = relink(LiftFolder.open(home / "lift"), home.parent / "found")
    lift.prepare_run()
    with lift.lock(), closing(EventWriter(home / "beside.jsonl")) as events, raises_key("at-work"):
        bake_frames(lift, ["0001"], events, StopSignal(home / "cancel"))


def test_renamed_classes_appear_in_the_next_result(home: Path) -> None:
    """Until then, what is baked and exported has the classes of the result."""
    lift, scene = relink(LiftFolder.open(home / "lift"), home.parent / "found"), home.parent / "found"
    table = scene / "panoptic.json"
    table.write_text(table.read_text().replace('"name": "chair"', '"name": "stool"'))
    assert "stool" not in [each.name for each in scene_of_lift(lift).classes.categories]
    own = ["bake", str(lift.path), "--frames", "0001", "-o", str(home / "own")]
    assert main(own) == ExitCode.FINISHED
    before = (home / "own" / "0001.exr").read_bytes()
    assert main(["lift", str(lift.path), "--resume"]) == ExitCode.FINISHED
    assert main(own) == ExitCode.BAD_INPUT, "the folder has the earlier state's passes"
    assert main([*own, "--replace"]) == ExitCode.FINISHED
    assert (home / "own" / "0001.exr").read_bytes() != before
    classes, objects = read_instances(lift.result_path / "instances.json")
    assert "stool" in [each.name for each in classes.categories] and "chair" not in {one.class_name for one in objects}
    assert "stool" in [each.name for each in scene_of_lift(lift).classes.categories]


def reclass(scene: Path, old: int, new: int) -> None:
    """Give the segments of a class another one."""
    table = scene / "panoptic.json"
    content = json.loads(table.read_text())
    for entry in content["annotations"]:
        for segment in entry["segments_info"]:
            segment["category_id"] = new if segment["category_id"] == old else segment["category_id"]
    table.write_text(json.dumps(content))


def moved(pose: Path) -> None:
    matrix = np.loadtxt(pose)
    matrix[0, 3] += 0.1
    np.savetxt(pose, matrix)


def darker(picture: Path) -> None:
    cv2.imwrite(str(picture), cv2.imread(str(picture), cv2.IMREAD_UNCHANGED) // 2)


def split(scene: Path, held_out: str) -> None:
    names = [path.stem for path in sorted((scene / "color").iterdir())]
    content = {"train": [name for name in names if name != held_out], "test": [held_out]}
    (scene / "splits.json").write_text(json.dumps(content))


def warnings_of(lift: Path) -> list[str]:
    return [str(event["message"]) for event in read_events(lift) if event["event"] == "warning"]


def read_events(lift: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (lift / "events.jsonl").read_text().splitlines()]
