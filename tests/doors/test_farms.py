"""What docs/farms.md promises of one machine; tests/batch has the faults of several."""

import csv
import json
import os
import subprocess
from pathlib import Path

import pytest

from engine.job import verify
from engine.machine.code_digest import code_digest
from tests.doors.terminal import Terminal
from tests.raises_key import worded
from tests.tiny_scene import write_tiny_scene

BATCH = ".venv/bin/python -m engine batch scans/* -o OUT --preset standard --bake all --export coco"
OF_A_TABLE = ".venv/bin/python -m engine batch --scenes scans.csv -o OUT --preset standard"
QUICK = ("--steps", "5", "--set", "warm_start=false", "--size", "64x48", "--workers", "1")


def rows_of(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "table.csv").open(newline="") as file:
        return {row["scene"]: row for row in csv.DictReader(file)}


@pytest.mark.slow
def test_a_batch_has_a_row_a_scene_and_continues_with_what_is_missing(shell: Terminal) -> None:
    pytest.importorskip("distributed")
    write_tiny_scene(shell.folder / "scans/room", 6, noise=0.1)
    (shell.folder / "scans/empty").mkdir(parents=True)
    told = shell.run(BATCH, code=2, OUT="out", more=QUICK)
    out = shell.folder / "out"
    assert "| room | done |" in told and "Dashboard: http://127.0.0.1:" in told
    made = {each.path.name for each in verify(out / "room/result").files}
    assert {f"{number:04d}.exr" for number in range(6)} <= made
    content = json.loads((out / "room/exports/coco/panoptic.json").read_text())
    assert len(content["images"]) == 6 and any(each["name"] == "chair" for each in content["categories"])
    rows = rows_of(out)
    assert rows["room"]["state"] == "done" and float(rows["room"]["miou"]) > 0.05
    assert rows["room"]["code"] == code_digest("engine") and worded("no-format").search(rows["empty"]["reason"])
    assert rows["mean"]["miou"] == rows["room"]["miou"]
    before = (out / "room/events.jsonl").read_bytes()
    assert "| room | done |" in shell.run(BATCH, code=2, OUT="out", more=QUICK)
    assert (out / "room/events.jsonl").read_bytes() == before, "nothing was missing"
    # A table gives each scene its own options, and adds its rows.
    write_tiny_scene(shell.folder / "scans/old/room", 6, up="y")
    table = "scene,name,up,masks,classes,set\nscans/old/room,old-room,y,,,voxel_size=0.3\n"
    (shell.folder / "scans.csv").write_text(table)
    shell.run(OF_A_TABLE, OUT="out", more=QUICK)
    request = json.loads((out / "old-room/request.json").read_text())
    assert request["overrides"]["voxel_size"] == 0.3 and request["up"] == "y"
    assert rows_of(out)["old-room"]["state"] == "done" and "room" in rows_of(out), "the earlier scene's row stays"


def test_a_studios_defaults_come_from_its_file_and_the_first_line_says_so(shell: Terminal) -> None:
    """A scene that has its masks elsewhere: without the defaults it would be refused for want of masks."""
    write_tiny_scene(shell.folder / "scans/room", 6, masks="none")
    write_tiny_scene(shell.folder / "masks/room", 6)
    defaults = 'preset = "preview"\nmasks = "masks/{scene}/panoptic.json"\nmemory = 0.5\n'
    (shell.folder / "studio.toml").write_text(defaults)
    command = [".venv/bin/python", "-m", "engine", "lift", "scans/room", "-o", "out"]
    variables = {**os.environ, "PLGS_DEFAULTS": str(shell.folder / "studio.toml")}
    ran = subprocess.run(command, cwd=shell.folder, env=variables, capture_output=True, text=True)
    assert ran.stderr.startswith(f"From {shell.folder / 'studio.toml'}: ") and "masks" in ran.stderr.splitlines()[0]
    assert ran.returncode == 2 and "0.5 GB" in ran.stderr, "less memory than a lift needs"
    (shell.folder / "studio.toml").write_text('presets = "preview"\n')
    ran = subprocess.run(command, cwd=shell.folder, env=variables, capture_output=True, text=True)
    assert ran.returncode == 2 and "presets" in ran.stderr, "other keys are refused"


def test_the_same_scene_twice_is_refused(shell: Terminal) -> None:
    pytest.importorskip("distributed")
    write_tiny_scene(shell.folder / "scans/room", 2)
    (shell.folder / "scans.csv").write_text("scene,name\nscans/room,a\nscans/room,b\n")
    assert worded("scene-twice").search(shell.run(OF_A_TABLE, code=2, OUT="out"))
