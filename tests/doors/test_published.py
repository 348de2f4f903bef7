"""A shot that was published stays as it is: docs/passes.md, "Nothing is overwritten by accident"."""

import re
from pathlib import Path

import OpenEXR
import pytest

from engine.corrections import read_corrected
from engine.passes.exr import read_note
from tests.doors.terminal import Terminal
from tests.doors.test_passes import CAMERA, shot_blend

CORRECT = ".venv/bin/python -m engine correct LIFT"
PRINTED = CAMERA.replace("1-250", "1-2")


@pytest.fixture
def room(terminal: Terminal) -> Terminal:
    shot_blend(terminal.folder)
    return terminal


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.exr"))}


def test_baking_a_changed_lift_makes_the_next_version_or_is_refused(room: Terminal) -> None:
    folder, lift = room.folder / "shots", "lifts/demo"
    by_version, fixed = (["--passes", "shots", "--shot", f"'{name}'"] for name in ("room_v{version:03d}", "night"))
    for name in (by_version, fixed):
        room.run(PRINTED, LIFT=lift, more=name)
    before = files_in(folder)
    assert [*before] == ["night.0001.exr", "night.0002.exr", "room_v001.0001.exr", "room_v001.0002.exr"]
    assert read_note(folder / "night.0001.exr", "plgs/lift") == "demo"
    assert len(read_note(folder / "night.0001.exr", "plgs/model") or "") == 129

    one = next(one.id for one in read_corrected(room.folder / lift).instances)
    room.run(CORRECT, LIFT=lift, more=["delete", str(one), "--no-object"])
    assert "--replace" in room.run(PRINTED, code=2, LIFT=lift, more=fixed)
    said = room.run(PRINTED.replace("1-2", "1"), LIFT=lift, more=by_version)
    assert "room_v002 is the next version of room_v001: the lift's corrections have changed" in said
    assert "room_v001 has frames that room_v002 lacks: 2" in said
    room.run(PRINTED.replace("1-2", "1"), LIFT=lift, more=by_version)  # the same again: nothing is left to do
    found = files_in(folder)
    assert [*{*found} - {*before}] == ["room_v002.0001.exr"] and found.items() >= before.items()
    said = room.run(PRINTED.replace("1-2", "1"), LIFT=lift, more=[*fixed, "--replace"])
    assert "frames of night still show its earlier state: 2" in said
    room.run(CORRECT, LIFT=lift, more=["undo"])
    room.run(PRINTED, LIFT=lift, more=by_version)  # as v001 shows it
    assert files_in(folder)["room_v001.0001.exr"] == before["room_v001.0001.exr"]


def test_bake_refuses_to_replace_frames_that_another_program_saved_again(room: Terminal) -> None:
    printed = ".venv/bin/python -m engine bake LIFT --frames all -o FOLDER"
    assert re.search(r"Baked 6 views in \d+ s: plate", room.run(printed, LIFT="lifts/demo", FOLDER="plate"))
    assert "Baked 0 views in 0 s; 6 were baked before: plate" in room.run(printed, LIFT="lifts/demo", FOLDER="plate")
    path = room.folder / "plate" / "0002.exr"
    with OpenEXR.File(str(path), separate_channels=True) as file:  # as a program does that keeps all attributes
        header = {**file.header(), "capDate": "2026:11:28 10:00:00"}
        with OpenEXR.File(header, file.channels()) as again:
            again.write(str(path))
    before = files_in(path.parent)
    assert "0002.exr" in room.run(printed, code=2, LIFT="lifts/demo", FOLDER="plate")
    path.unlink()
    path.symlink_to("nowhere")
    assert "0002.exr" in room.run(printed, code=2, LIFT="lifts/demo", FOLDER="plate") and path.is_symlink()
    path.unlink()
    room.run(printed, LIFT="lifts/demo", FOLDER="plate")
    whole = path.read_bytes()
    for size in (len(whole) - 1, len(whole) // 2):  # as an interrupted copy leaves it
        path.write_bytes(whole[:size])
        assert "Baked 1 view" in room.run(printed, LIFT="lifts/demo", FOLDER="plate")
    before |= {path.name: path.read_bytes()}
    one = next(one.id for one in read_corrected(room.folder / "lifts/demo").instances)
    room.run(CORRECT, LIFT="lifts/demo", more=["delete", str(one), "--no-object"])
    said = room.run(printed, code=2, LIFT="lifts/demo", FOLDER="plate")
    assert "other corrections" in said and "--replace" in said and files_in(path.parent) == before
    room.run(printed, LIFT="lifts/demo", FOLDER="plate", more=["--replace"])
    assert files_in(path.parent) != before
