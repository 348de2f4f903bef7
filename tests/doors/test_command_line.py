"""What docs/command-line.md promises."""

import hashlib
import json
import platform
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.command_line.main import main
from engine.job import progress
from engine.presets.preset import PRESETS
from tests.conftest import HAS_BLENDER
from tests.doors.terminal import ROOT, Terminal
from tests.raises_key import worded
from tests.tiny_scene import CATEGORIES, write_tiny_scene
from tests.waiting import PATIENCE_S, wait_until

RUN = ".venv/bin/python run_plgs.py SCENE -o OUT"
COMMAND = ".venv/bin/python -m engine COMMAND"
ENGINE = ".venv/bin/python -m engine "
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
    added = re.findall(r"`(\w+)`", table[table.index("| `add NAME` |") :].splitlines()[0].split("|")[2])
    assert len(added) == 6 and f"one of {', '.join(added)}" in " ".join(shell.run(ENGINE + "add --help").split())
    research = shell.run(".venv/bin/python -m research --help")
    assert {"reliability", "experiments", "bench", "unfinished"} <= {*re.findall(r"\w+", research)}


def test_presets_lists_all_options_as_a_file_for_preset(shell: Terminal) -> None:
    assert {*PRESETS} <= {line.split()[0] for line in shell.run(COMMAND, COMMAND="presets").splitlines() if line}
    changed = ["--set", "weights.depth=0", "--set", "steps=7"]
    printed = shell.run(PRESET, more=changed, NAME="standard")
    assert "steps = 7" in printed and "depth = 0.0" in printed
    (shell.folder / "mine.toml").write_text(printed)
    assert shell.run(PRESET, NAME="mine.toml") == printed
    values = json.loads(shell.run(PRESET, more=["--json", "--set", "voxel_size=0.5"], NAME="mine.toml"))
    assert (values["weights.depth"], values["steps"], values["voxel_size"]) == (0.0, 7, 0.5) and values["objects"]
    for name in PRESETS:  # the most frames to train on, and whether the masks of the others vote
        values = json.loads(shell.run(PRESET, more=["--json"], NAME=name))
        assert values["frames"] == (400 if name in ("draft", "preview") else 900)
        assert values["all_frames_vote"] == (name != "paper")


def test_bad_input_gives_a_one_line_error_and_exit_code_2(shell: Terminal) -> None:
    """The line says what, where, and what to do."""
    told = shell.run(COMMAND, code=2, more=["nowhere"], COMMAND="inspect")
    assert told.startswith("error: ") and told.count("\n") == 1 and "nowhere" in told


def test_lifting_into_a_folder_with_other_files_is_refused(shell: Terminal, tmp_path: Path) -> None:
    write_tiny_scene(shell.folder / "room", 6)
    (shell.folder / "out").mkdir()
    (shell.folder / "out/notes.txt").write_text("mine")
    told = shell.run(RUN, code=2, SCENE="room", OUT="out") if HAS_BLENDER else ""
    told += shell.run(COMMAND, code=2, more=["room", "-o", "out"], COMMAND="lift")
    assert worded("folder-used").search(told)
    assert [path.name for path in (shell.folder / "out").iterdir()] == ["notes.txt"]


def test_progress_json_prints_nothing_but_events_to_standard_output(shell: Terminal) -> None:
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


@pytest.mark.parametrize("command", [
    "", "inspect scans/room", "frames scans/room -o out", "bake lifts/demo --frames all", "correct lifts/demo remove 1",
    "export lifts/demo --to gltf -o out", "export lifts/demo --to surface -o out", "export lifts/demo --to usd -o out",
])  # fmt: skip
def test_a_stage_never_counts_backwards(command: str, terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the lift itself, without a command: its events have the end of each part of a stage, however fast."""
    monkeypatch.setattr(progress, "REPORT_EVERY_S", 0.0)
    monkeypatch.chdir(terminal.folder)
    events = Path("said.jsonl" if command else "lifts/demo/events.jsonl")
    if command:
        assert main([*command.split(), "--events", str(events)]) == 0
    shares: dict[str, list[float]] = {}
    for each in map(json.loads, events.read_text().splitlines()):
        if each["event"] == "progress":
            shares.setdefault(each["stage"], []).append(each["step"] / each["steps"])
    assert shares and {name: told for name, told in shares.items() if told != sorted(told)} == {}


def test_evaluate_scores_masks_of_other_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_inspect_predicts_the_time_and_memory_of_a_lift(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = write_tiny_scene(tmp_path / "room", 9)
    assert main(["inspect", str(room), "--preset", "standard"]) == 0
    assert re.search(r"\nstandard  about \d+ min and \d+\.\d GB of memory\n$", capsys.readouterr().out)


def test_bake_selects_frames_by_the_last_number_in_their_names(terminal: Terminal) -> None:
    terminal.run(ENGINE + "bake lifts/demo --frames 1-5:2")
    assert [path.stem for path in sorted((terminal.folder / "lifts/demo/result/passes").glob("*.exr"))] == [
        "0001", "0003", "0004", "0005"
    ]  # fmt: skip


def test_find_scene_mends_a_lift_whose_scene_moved(terminal: Terminal) -> None:
    (terminal.folder / "scans/room").rename(terminal.folder / "kitchen")
    said = terminal.run(ENGINE + "find-scene LIFT SCENE", LIFT="lifts/demo", SCENE="kitchen")
    assert said.strip() == f"The lift now reads the scene {terminal.folder / 'kitchen'}"
    request = json.loads((terminal.folder / "lifts/demo/request.json").read_text())
    assert (request["scene"], request["relative"]["scene"]) == (str(terminal.folder / "kitchen"), "../../kitchen")
    write_tiny_scene(terminal.folder / "other", 6, size=(80, 60))
    told = terminal.run(ENGINE + "find-scene LIFT SCENE", LIFT="lifts/demo", SCENE="other", code=2)
    assert worded("other-scene").search(told)


def test_writing_classes_toml_renames_the_users_own_classes_toml_first(shell: Terminal) -> None:
    room = write_tiny_scene(shell.folder / "room", 2)
    (room / "classes.toml").write_text("# mine\n")
    listed = json.loads(shell.run(ENGINE + "classes SCENE --json", SCENE="room"))
    [chair] = [row for row in listed["rows"] if row["name"] == "chair"]
    chair["name"] = chair["into"] = "seat"
    (shell.folder / "edited.json").write_text(json.dumps(listed))
    for _ in range(2):  # the second time it is a file of ours
        shell.run(ENGINE + "classes room --write FILE.json", **{"FILE.json": "edited.json"})
        assert (room / "classes.before.toml").read_text() == "# mine\n"
        assert [path.name for path in sorted(room.glob("classes*"))] == ["classes.before.toml", "classes.toml"]
    assert "     5  seat" in shell.run(ENGINE + "classes SCENE", SCENE="room").splitlines()


def test_an_export_lists_every_file_it_wrote_with_its_digest(terminal: Terminal) -> None:
    terminal.run(ENGINE + "export LIFT --to FORM -o FOLDER", LIFT="lifts/demo", FORM="boxes", FOLDER="boxes")
    out = terminal.folder / "boxes"
    lines = [json.loads(line) for line in (out / ".plgs-written.jsonl").read_text().splitlines()]
    listed = {line["file"]: line["sha256"] for line in lines if "sha256" in line}
    assert listed == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in out.iterdir() if path.suffix != ".jsonl"
    }
    assert lines[-1] == {"complete": True}
    (out / "boxes.csv").write_text("mine")
    told = terminal.run(ENGINE + "export lifts/demo --to boxes -o boxes", code=2)
    assert worded("foreign-file").search(told) and "boxes.csv" in told and (out / "boxes.csv").read_text() == "mine"


@contextmanager
def lifting(shell: Terminal, arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A lift that trains, in a Python of its own."""
    command, events = [sys.executable, "-m", "engine", "lift", *arguments.split()], shell.folder / "out/events.jsonl"
    before = events.read_text().count('"train"') if events.exists() else 0
    with subprocess.Popen(command, cwd=shell.folder, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(lambda: process.poll() is not None or (
                events.exists() and events.read_text().count('"train"') > before + 2
            ))  # fmt: skip
            yield process
        finally:
            process.kill()


@pytest.mark.slow
def test_a_stopped_lift_ends_with_its_code_and_resume_goes_on(shell: Terminal) -> None:
    """The runs are of one lift. While one works, a second command is told to try again."""
    write_tiny_scene(shell.folder / "room", 6)
    new = "room -o out --set warm_start=false --set voxel_size=0.2 --steps 100000"
    stops: list[tuple[Callable[[subprocess.Popen[str]], object], int]] = [
        (lambda process: process.send_signal(signal.SIGHUP), 129),
        (lambda process: process.send_signal(signal.SIGINT), 130),
        (lambda process: process.send_signal(signal.SIGTERM), 143),
        (lambda _: (shell.folder / "out/cancel").touch(), 3),
    ]
    for number, (stop, code) in enumerate(stops):
        with lifting(shell, f"{new} --resume" if number else new) as process:
            if code == 3:
                told = shell.run(ENGINE + "lift out --resume", code=75)
                [engine] = [
                    line for line in (shell.folder / "out/events.jsonl").read_text().splitlines() if '"hello"' in line
                ][-1:]
                assert worded("at-work").search(told) and "since 20" in told
                assert f"(process {json.loads(engine)['pid']} on {platform.node()}" in told
            stop(process)
            assert process.wait(PATIENCE_S) == code
            assert "--resume" in process.stderr.read()  # type: ignore[union-attr]
    steps = [json.loads(line)["step"] for line in (shell.folder / "out/events.jsonl").read_text().splitlines()
             if '"progress"' in line and '"train"' in line]  # fmt: skip
    assert steps == sorted(steps) and len(steps) > 8, "each went on"


@pytest.mark.slow
def test_resume_repairs_a_damaged_result_bit_for_bit(shell: Terminal) -> None:
    write_tiny_scene(shell.folder / "room", 6)
    new = ENGINE + "lift room -o out --set voxel_size=0.2 --device auto --bake all"
    assert "warning: this lift runs on the CPU: " in shell.run(new, more=QUICK)
    result = shell.folder / "out/result"
    before = {path.relative_to(result): path.read_bytes() for path in result.rglob("*") if path.is_file()}
    (result / "gaussians.ply").write_bytes(b"cut")
    (result / "passes/0002.exr").unlink()
    assert "lift LIFT --resume" in shell.run(ENGINE + "bake out", code=2)
    assert "out/result/gaussians.ply" in shell.run(ENGINE + "lift out --resume")
    after = {path.relative_to(result): path.read_bytes() for path in result.rglob("*") if path.is_file()}
    assert before.keys() == after.keys()
    assert {name for name in before if before[name] != after[name]} <= {Path("manifest.json"), Path("metrics.json")}


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
