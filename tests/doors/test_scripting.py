"""What docs/scripting.md promises: its scripts are run as printed, and its operators take what the table says."""

import csv
import hashlib
import json
import re
from pathlib import Path

import bpy
import numpy as np
import pytest

import engine
from engine.lift.run import NO_VOTES
from tests.doors.terminal import ROOT, Terminal
from tests.raises_key import worded

PAGE = (ROOT / "docs/scripting.md").read_text(encoding="utf-8")
TENSORBOARD = """python -c "import csv, sys; from torch.utils.tensorboard import SummaryWriter as W; w = W(sys.argv[1]); [w.add_scalar(k, float(v), int(r['step'])) for r in csv.DictReader(open(sys.argv[1] + '/training.csv')) for k, v in r.items()]; w.close()" LIFT && tensorboard --logdir LIFT"""  # noqa: E501

OWN = '''"""A loss and a head of one's own, as the table names them: SCENE LIFT"""
import sys
from pathlib import Path
from engine.command_line.run_engine import run_engine
from engine.job import LiftFolder, LiftRequest
from engine.model.decoders import Decoders, register_head
from engine.train.trainer import register_loss

class Mine(Decoders):
    kind = "mine"

def mine(step):
    print("a loss is asked for")
    return 5.0 * step.rendering.alpha.mean()

register_head(Mine)
register_loss("mine", mine)
options = {"losses": ["depth", "mine"], "head": "mine", "steps": 4, "warm_start": False, "voxel_size": 0.2}
raise SystemExit(run_engine(LiftFolder.create(Path(sys.argv[2]), LiftRequest(Path(sys.argv[1]), options=options))))
'''


def script(begin: str) -> str:
    """The Python block of the page that begins so."""
    return re.search(rf"```python\n({re.escape(begin)}.*?)```", PAGE, re.DOTALL)[1]


def save(terminal: Terminal, name: str, begin: str) -> None:
    (terminal.folder / name).write_text(script(begin))


def test_a_script_lifts_a_scene_and_lists_its_objects(terminal: Terminal) -> None:
    save(terminal, "lift_and_list.py", '"""Lift a scene')
    printed = ".venv/bin/python lift_and_list.py sample/room lifts/room --preset preview"
    assert printed in PAGE
    quick = ["--steps", "5", "--set", "warm_start=false"]
    said = terminal.run(printed.replace("sample/room", "scans/room"), more=quick)
    assert "6 frames" in said and "chair 1" in said and "0004 {" in said


def test_a_script_prints_statistics_of_each_object(terminal: Terminal) -> None:
    save(terminal, "statistics_of_lift.py", '"""Statistics')
    terminal.run(".venv/bin/python statistics_of_lift.py lifts/demo table.csv")
    rows = list(csv.DictReader((terminal.folder / "table.csv").open()))
    chair = next(row for row in rows if row["name"] == "chair 1")
    assert {row["class"] for row in rows} == {"chair", "cabinet"}
    assert float(chair["height"]) == pytest.approx(0.9, abs=0.15) and float(chair["above_floor"]) < 0.1


def test_a_users_own_matcher_is_named_in_the_manifest_with_its_digest(terminal: Terminal) -> None:
    save(terminal, "matcher.py", '"""Lift with a matcher')
    terminal.run(".venv/bin/python matcher.py scans/room lifts/own 3")
    manifest = json.loads((terminal.folder / "lifts/own/result/manifest.json").read_text())
    digest = hashlib.sha256((terminal.folder / "matcher.py").read_bytes()).hexdigest()[:8]
    assert manifest["versions"]["matcher seen_twice"] == digest and manifest["settings"]["objects"] == "seen_twice"
    assert NO_VOTES in (terminal.folder / "lifts/own/events.jsonl").read_text().replace('\\"', '"'), "no label_maps"
    instances = engine.read_lift(terminal.folder / "lifts/own").instances
    assert instances and all(one.views > 1 for one in instances)
    assert "error:" in terminal.run(".venv/bin/python matcher.py scans/room lifts/own 3", code=1), "the folder is used"


def test_a_users_own_loss_and_head_are_used_and_needed_to_read_the_lift(terminal: Terminal) -> None:
    (terminal.folder / "own.py").write_text(OWN)
    terminal.run(".venv/bin/python own.py scans/room lifts/mine")
    rows = list(csv.DictReader((terminal.folder / "lifts/mine/training.csv").open()))
    assert len(rows) == 4 and all(0 < float(row["mine"]) <= 5 for row in rows) and "depth" in rows[0]
    assert float(rows[0]["loss"]) > 0.5 * float(rows[0]["mine"])
    versions = json.loads((terminal.folder / "lifts/mine/result/manifest.json").read_text())["versions"]
    assert {"loss mine", "head mine"} <= {*versions}
    assert "a loss is asked for" in (terminal.folder / "lifts/mine/log.txt").read_text(), "what is printed"
    told = terminal.run(".venv/bin/python -m engine bake lifts/mine --frames 0001", code=2)
    assert worded("model-unreadable").search(told) and "only the script" in told and "Traceback" not in told


def test_read_lift_gives_a_lift_as_arrays(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(terminal.folder)
    names: dict[str, object] = {}
    exec(script("import engine").replace("lifts/room", "lifts/demo"), names)
    xyz = names["xyz"]
    assert isinstance(xyz, np.ndarray) and xyz.dtype == np.float32 and len(xyz) > 100
    lift = engine.read_lift("lifts/demo")
    np.testing.assert_allclose(np.linalg.norm(lift.gaussians.rotation, axis=1), 1.0, atol=1e-4)
    assert (lift.gaussians.opacity >= 0).all() and (lift.gaussians.opacity <= 1).all()
    assert lift.frames[0].camera.K.shape == (3, 3) and lift.frames[0].camera.camera_to_world.shape == (4, 4)


def test_training_csv_has_a_line_for_each_step_of_numbers(terminal: Terminal) -> None:
    """What the page's line for TensorBoard reads; the package itself is none of ours."""
    assert TENSORBOARD in PAGE
    rows = list(csv.DictReader((terminal.folder / "lifts/demo/training.csv").open()))
    assert [int(row["step"]) for row in rows] == [*range(1, 13)]
    assert {"loss", "depth", "gaussians", "seconds"} <= {*rows[0]}
    assert all(np.isfinite([float(value) for value in row.values()]).all() for row in rows)


BY_FOLDER = "watch_lift place_lift open_log cancel_lift resume_lift bake_passes bake_camera export_lift".split()
ON_RESULT = ("select_instance", "select_class", "go_to_mask", "show_as", "rename_instance", "make_objects", "put_back")
UNSAID = {"rna_type", "lift", "lift_folder", "filter_glob", "check_existing", "what"}
"""What the text before the table says; and what Blender's file browser and a dialog give."""


def test_every_operator_has_the_arguments_of_the_table_and_no_others(extension: None) -> None:
    """A row may name several operators; then an argument belongs to at least one of them."""
    table = PAGE[PAGE.index("| operator `plgs.`") :].split("\n\n")[0].splitlines()[2:]
    rows = [line.split("|")[1:3] for line in table]
    named = {operators: re.findall(r"`(\w+)`", operators) for operators, _ in rows}
    assert sorted(name for each in named.values() for name in each) == sorted(dir(bpy.ops.plgs))
    known = {name: {*getattr(bpy.ops.plgs, name).get_rna_type().properties.keys()} for name in dir(bpy.ops.plgs)}
    for operators, arguments in rows:
        there = set().union(*(known[name] for name in named[operators]))
        said = {*re.findall(r"`([a-z_]+)`", re.sub(r"\(.*?\)", "", arguments))}
        said |= {"filepath"} if "directory" in said else set()  # as the file browser gives it
        if "import_scene" in said:  # "those of `import_scene` without `cloud`"
            said = said - {"import_scene", "cloud"} | known["import_scene"] - {"cloud"}
        assert said - {"filepath"} - there == set(), operators
        if not re.search("try_sample|browse_scene", operators):  # which import, too
            assert there - said - UNSAID == set(), operators
    assert all("lift" in known[name] for name in ON_RESULT) and all("lift_folder" in known[name] for name in BY_FOLDER)


def test_the_operators_of_the_page_lift_and_bake(
    terminal: Terminal, extension: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(terminal.folder)
    lines = script("bpy.ops.plgs.import_scene").replace("sample/room", str(terminal.folder / "scans/room"))
    lines = lines.replace("lifts/room", str(terminal.folder / "lifts/room"))
    lines = lines.replace('preset="standard"', 'preset="preview", steps=3, preset_options="voxel_size=0.2"')
    exec(lines.replace("instance=3", "instance=2"), {"bpy": bpy})
    baked = Path(terminal.folder / "lifts/room/result/passes")
    assert [path.stem for path in sorted(baked.glob("*.exr"))] == [f"{number:04d}" for number in range(6)]
