"""What docs/command-line.md promises."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.command_line.main import main
from engine.presets.preset import PRESETS
from tests.conftest import HAS_BLENDER
from tests.doors.terminal import ROOT, Terminal
from tests.raises_key import worded
from tests.tiny_scene import CATEGORIES, write_tiny_scene

RUN = ".venv/bin/python run_plgs.py SCENE -o OUT"
COMMAND = ".venv/bin/python -m engine COMMAND"
PRESET = ".venv/bin/python -m engine presets NAME"
QUICK = ("--steps", "5", "--set", "warm_start=false")


def test_every_command_has_help(shell: Terminal) -> None:
    page = (ROOT / "docs/command-line.md").read_text(encoding="utf-8")
    table = page[page.index("## Without Blender") : page.index("`.venv/bin/python -m research`")]
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    names = {name for cell in cells for name in re.findall(r"`([a-z][a-z-]+)", cell)}
    assert len(names) > 15
    for name in sorted(names):
        assert f"engine {name}" in shell.run(COMMAND, more=["--help"], COMMAND=name)


def test_presets_lists_all_options_as_a_file_for_preset(shell: Terminal) -> None:
    assert {*PRESETS} <= {line.split()[0] for line in shell.run(COMMAND, COMMAND="presets").splitlines() if line}
    changed = ["--set", "weights.depth=0", "--set", "steps=7"]
    printed = shell.run(PRESET, more=changed, NAME="standard")
    assert "steps = 7" in printed and "depth = 0.0" in printed
    (shell.folder / "mine.toml").write_text(printed)
    assert shell.run(PRESET, NAME="mine.toml") == printed
    values = json.loads(shell.run(PRESET, more=["--json", "--set", "voxel_size=0.5"], NAME="mine.toml"))
    assert (values["weights.depth"], values["steps"], values["voxel_size"]) == (0.0, 7, 0.5) and values["objects"]


def test_bad_input_is_one_line_and_exit_code_2(shell: Terminal) -> None:
    """The line says what, where, and what to do."""
    told = shell.run(COMMAND, code=2, more=["nowhere"], COMMAND="inspect")
    assert told.startswith("error: ") and told.count("\n") == 1 and "nowhere" in told


def test_an_existing_folder_is_refused_never_overwritten(shell: Terminal, tmp_path: Path) -> None:
    write_tiny_scene(shell.folder / "room", 6)
    (shell.folder / "out").mkdir()
    (shell.folder / "out/notes.txt").write_text("mine")
    told = shell.run(RUN, code=2, SCENE="room", OUT="out") if HAS_BLENDER else ""
    told += shell.run(COMMAND, code=2, more=["room", "-o", "out"], COMMAND="lift")
    assert worded("folder-used").search(told)
    assert [path.name for path in (shell.folder / "out").iterdir()] == ["notes.txt"]


def test_with_progress_json_standard_output_has_nothing_but_events(shell: Terminal) -> None:
    write_tiny_scene(shell.folder / "room", 6)
    for scene, code, last in (("room", 0, "done"), ("nowhere", 2, "error")):
        command = [".venv/bin/python", "-m", "engine", "inspect", scene, "--progress", "json"]
        for more in ([], ["--events", f"{scene}.jsonl"]):
            ran = subprocess.run([*command, *more], cwd=shell.folder, capture_output=True, text=True)
            events = [json.loads(line) for line in ran.stdout.splitlines()]
            assert ran.returncode == code and (events[0]["event"], events[-1]["event"]) == ("hello", last)
            assert [each["seq"] for each in events] == [*range(1, len(events) + 1)]
            assert code == 0 or (ran.stderr.startswith("error: ") and events[-1]["exit_code"] == 2)
        assert (shell.folder / f"{scene}.jsonl").read_text() == ran.stdout


def test_evaluate_scores_anybodys_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """PNGs of class and instance ids, written by OpenCV: the truth itself, and with one of two objects unseen."""
    room = write_tiny_scene(tmp_path / "room", 4)
    classes = [{"id": each["id"], "name": each["name"], "is_thing": bool(each["isthing"])} for each in CATEGORIES]
    (room / "gt/labels.json").write_text(json.dumps({"classes": classes}))
    predictions: dict[str, Path] = {"all": tmp_path / "all", "without chairs": tmp_path / "without"}
    for name, folder in predictions.items():
        for kind in ("semantic", "instance"):
            (folder / kind).mkdir(parents=True)
        for path in sorted((room / "gt/semantic").iterdir()):
            semantic = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            instance = cv2.imread(str(room / "gt/instance" / path.name), cv2.IMREAD_UNCHANGED)
            hidden = (semantic == 5) & (name != "all")
            cv2.imwrite(str(folder / "semantic" / path.name), np.where(hidden, 1, semantic).astype(np.uint8))
            cv2.imwrite(str(folder / "instance" / path.name), np.where(hidden, 0, instance).astype(np.uint16))
    found = {}
    for name, folder in predictions.items():
        capsys.readouterr()
        assert main(["evaluate", "--predictions", str(folder), "--truth", str(room / "gt"), "--json"]) == 0
        told: Any = json.loads(capsys.readouterr().out.splitlines()[-1])
        found[name] = told["tables"][0]
    assert (found["all"]["miou"], found["all"]["pq"]) == (1.0, 1.0)
    assert found["without chairs"]["pq"] < 0.9 and found["without chairs"]["miou"] < 0.9


def test_inspect_predicts_what_a_lift_would_take(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = write_tiny_scene(tmp_path / "room", 9)
    assert main(["inspect", str(room), "--preset", "standard"]) == 0
    assert re.search(r"\nstandard  about \d+ min and \d+\.\d GB of memory\n$", capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.skipif(not HAS_BLENDER, reason="needs bpy")
def test_run_plgs_lifts_the_scene_and_puts_the_result_into_a_blend(shell: Terminal) -> None:
    import bpy

    write_tiny_scene(shell.folder / "room", 8)
    told = shell.run(RUN, SCENE="room", OUT="out", more=QUICK)
    assert "lift.blend" in told and "mIoU" in told
    shutil.copy(shell.folder / "out/lift.blend", shell.folder / "read.blend")
    with bpy.data.libraries.load(str(shell.folder / "read.blend")) as (held, _):
        assert any("chair" in name for name in held.objects) and held.collections
    told = shell.run(RUN, SCENE="room", OUT="out", more=QUICK, code=2)
    assert worded("holds-lift").search(told)
