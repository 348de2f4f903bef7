"""Exports from a script: the engine's own command, and meshes that arrive in the scene."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender import engine_environment
from plgs.plgs_blender.running import exports

PRETENCE = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from tests.plgs_blender.surface_file import write_surface

print("3 of 4 frames", file=sys.stderr, flush=True)
write_surface(Path(sys.argv[1]) / "mesh.ply")
"""


@pytest.fixture(autouse=True)
def engine(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The Python that runs the tests is the engine's."""
    monkeypatch.setattr(engine_environment, "usable_python", lambda: Path(sys.executable))
    yield
    exports.let_go()


needs_engine = pytest.mark.skipif(find_spec("torch") is None, reason="the engine runs in another Python")


def test_the_command_knows_every_form(root: Path) -> None:
    text = (root / "engine" / "command_line" / "parser.py").read_text()
    assert f"EXPORTS = {tuple(exports.FORMS)}".replace("'", '"') in text


@needs_engine
def test_forms_are_exported_by_the_engine(lift: Path, tmp_path: Path) -> None:
    boxes = tmp_path / "boxes"
    assert bpy.ops.plgs.export_lift(form="boxes", directory=str(boxes), lift_folder=str(lift)) == {"FINISHED"}
    with (boxes / "boxes.csv").open(newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == ["chair 1", "cabinet 1"]
    bpy.context.scene.plgs.lift_folder = str(lift)
    coco = tmp_path / "coco"
    assert bpy.ops.plgs.export_lift(form="coco", directory=str(coco), frames="test") == {"FINISHED"}
    assert len(json.loads((coco / "panoptic.json").read_text())["images"]) == 2
    shown = exports.latest()
    assert shown is not None and (shown.done, shown.total) == (2, 2) and str(coco) in shown.message


@needs_engine
def test_what_goes_wrong_is_told(lift: Path, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="needs a folder"):
        bpy.ops.plgs.export_lift(form="coco", lift_folder=str(lift))
    (tmp_path / "file").touch()
    with pytest.raises(RuntimeError, match="this is a file"):
        bpy.ops.plgs.export_lift(form="boxes", directory=str(tmp_path / "file"), lift_folder=str(lift))


def test_meshes_are_made_and_placed(lift: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    lift = shutil.copytree(lift, tmp_path / "lift")
    asked = []

    def command(python: Path, folder: Path, form: str, output: Path, frames: list[str]) -> list[str | Path]:
        asked.append((folder, form, frames))
        output.mkdir(parents=True)
        return [python, "-c", PRETENCE, output, root]

    monkeypatch.setattr(exports, "export_command", command)
    bpy.ops.plgs.place_lift(lift_folder=str(lift))
    bpy.context.scene.plgs.lift_folder = ""
    assert bpy.ops.plgs.make_meshes() == {"FINISHED"}
    assert asked == [(lift, "mesh", ["all"])]
    names = {ob.name for ob in bpy.context.scene.objects if ob.get("plgs_key", "").startswith("mesh:")}
    assert len(names) == 2


def test_a_cancelled_export_is_no_error(lift: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exports, "export_command", lambda python, *_: [python, "-c", "import time; time.sleep(600)"])
    export = exports.start(lift, "coco", tmp_path, Path(sys.executable))
    assert not bpy.ops.plgs.export_lift.poll(), "one at a time"
    bpy.ops.plgs.cancel_export()
    exports.wait_for(export)
    assert export.error is None and export.message == "The export was cancelled"
