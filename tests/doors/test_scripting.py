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
from tests.doors.terminal import ROOT, Terminal

PAGE = (ROOT / "docs/scripting.md").read_text(encoding="utf-8")
TENSORBOARD = """python -c "import csv, sys; from torch.utils.tensorboard import SummaryWriter as W; w = W(sys.argv[1]); [w.add_scalar(k, float(v), int(r['step'])) for r in csv.DictReader(open(sys.argv[1] + '/training.csv')) for k, v in r.items()]; w.close()" LIFT && tensorboard --logdir LIFT"""  # noqa: E501


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


def test_a_matcher_of_ones_own_is_named_in_the_manifest_with_the_digest_of_its_file(terminal: Terminal) -> None:
    save(terminal, "matcher.py", '"""Lift with a matcher')
    terminal.run(".venv/bin/python matcher.py scans/room lifts/own 3")
    manifest = json.loads((terminal.folder / "lifts/own/result/manifest.json").read_text())
    digest = hashlib.sha256((terminal.folder / "matcher.py").read_bytes()).hexdigest()[:8]
    assert manifest["versions"]["matcher seen_twice"] == digest and manifest["settings"]["objects"] == "seen_twice"
    assert "error:" in terminal.run(".venv/bin/python matcher.py scans/room lifts/own 3", code=1), "the folder is used"


def test_a_lift_is_read_as_arrays(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert all(np.isfinite([float(value) for value in row.values()]).all() for row in rows)


def test_every_operator_takes_the_arguments_of_the_table(extension: None) -> None:
    """A row may name several operators; then an argument belongs to at least one of them."""
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| (.*?) \| ", PAGE[PAGE.index("| operator `plgs.`") :], re.MULTILINE)
    assert len(rows) > 30
    for operators, arguments in rows:
        known = [getattr(bpy.ops.plgs, name).get_rna_type().properties for name in re.findall(r"`(\w+)`", operators)]
        for argument in re.findall(r"`([a-z_]+)`", re.sub(r"\(.*?\)", "", arguments)):
            if argument not in ("import_scene", "cloud"):  # "those of `import_scene` without `cloud`"
                assert any(argument in each for each in known), f"{operators}: {argument}"


def test_the_operators_of_the_page_lift_and_bake(
    terminal: Terminal, extension: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(terminal.folder)
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", str(terminal.folder / ".venv/bin/python"))
    lines = script("bpy.ops.plgs.import_scene").replace("sample/room", str(terminal.folder / "scans/room"))
    lines = lines.replace("lifts/room", str(terminal.folder / "lifts/room"))
    lines = lines.replace('preset="standard"', 'preset="preview", steps=3, preset_options="voxel_size=0.2"')
    exec(lines.replace("instance=3", "instance=2"), {"bpy": bpy})
    baked = Path(terminal.folder / "lifts/room/result/passes")
    assert [path.stem for path in sorted(baked.glob("*.exr"))] == [f"{number:04d}" for number in range(6)]
