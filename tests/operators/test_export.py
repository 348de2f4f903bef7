"""Exports from a script: the engine's own command, and meshes that arrive in the scene."""

import csv
import json
import re
import shutil
import sys
from ast import literal_eval
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from plgs.engine.job.follower import TaskFollower
from plgs.engine.job.process import EngineProcess
from plgs.engine.job.task import TaskFiles
from plgs.plgs_blender import registry
from plgs.plgs_blender.lift_scene import place_lift
from plgs.plgs_blender.running import exports
from surface_file import write_surface
from tiny_scene import CHAIR_ID, FLOOR_ID

from tests.raises_key import raises_key, worded

PRETENCE = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from tests.plgs_blender.surface_file import write_surface

Path(sys.argv[1]).mkdir(parents=True)
write_surface(Path(sys.argv[1]) / "mesh.ply")
"""


@pytest.fixture(autouse=True)
def engine() -> Iterator[None]:
    yield
    registry.forget_all()


needs_engine = pytest.mark.skipif(find_spec("torch") is None, reason="the engine runs in another Python")


def test_the_export_operator_offers_every_format_of_the_engine(root: Path) -> None:
    text = (root / "engine" / "command_line" / "main.py").read_text()
    known = re.search(r"^EXPORTS = (\(.*?\))", text, re.DOTALL | re.MULTILINE)
    assert known is not None and sorted(literal_eval(known[1])) == sorted(exports.FORMS)


@needs_engine
def test_export_lift_writes_boxes_and_coco_masks(lift: Path, tmp_path: Path) -> None:
    boxes = tmp_path / "boxes"
    assert bpy.ops.plgs.export_lift(form="boxes", directory=str(boxes), lift_folder=str(lift)) == {"FINISHED"}
    with (boxes / "boxes.csv").open(newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == ["chair 1", "cabinet 1"]
    bpy.context.scene.plgs.lift_folder = str(lift)
    coco = tmp_path / "coco"
    assert bpy.ops.plgs.export_lift(form="coco", directory=str(coco), frames="test") == {"FINISHED"}
    assert len(json.loads((coco / "panoptic.json").read_text())["images"]) == 2
    shown = registry.latest(exports.Export)
    assert shown is not None and (shown.progress.step, shown.progress.steps) == (2, 2) and str(coco) in shown.message


@needs_engine
def test_an_export_without_a_folder_or_to_a_file_is_refused(lift: Path, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=worded("folder-needed")):
        bpy.ops.plgs.export_lift(form="coco", lift_folder=str(lift))
    (tmp_path / "file").touch()
    with pytest.raises(RuntimeError, match=worded("file-not-folder")):
        bpy.ops.plgs.export_lift(form="boxes", directory=str(tmp_path / "file"), lift_folder=str(lift))


def pretend(monkeypatch: pytest.MonkeyPatch, program: str, *arguments: object) -> list[list[str]]:
    """Let exports run a program instead of the engine; the arguments that the engine would get."""
    asked: list[list[str]] = []

    def start_engine(kind: str, python: Path, *given: object) -> TaskFollower:
        asked.append([str(each) for each in given])
        output = given[given.index("-o") + 1]
        command = [sys.executable, "-c", program, output, *arguments]
        return TaskFollower(TaskFiles.temporary(), EngineProcess(command), kind=kind)

    monkeypatch.setattr(exports, "start_engine", start_engine)
    return asked


def test_meshes_are_made_and_placed(lift: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    lift = shutil.copytree(lift, tmp_path / "lift")
    asked = pretend(monkeypatch, PRETENCE, root)
    bpy.ops.plgs.place_lift(lift_folder=str(lift))
    bpy.context.scene.plgs.lift_folder = ""
    assert bpy.ops.plgs.make_meshes() == {"FINISHED"}
    (arguments,) = asked
    assert arguments[0] == str(lift) and arguments[1:3] == ["--to", "surface"] and arguments[-2:] == ["--frames", "all"]
    names = {ob.name for ob in bpy.context.scene.objects if ob.get("plgs_key", "").startswith("mesh:")}
    assert len(names) == 2


def test_blender_exports_the_objects_that_the_list_shows_and_keeps_the_scene(mine: Path, tmp_path: Path) -> None:
    """By Blender itself: names, pictures and what the lists hide; the scene is as it was."""
    write_surface(mine / "exports" / "surface" / "mesh.ply", shade=40)
    assert not bpy.ops.plgs.export_shown.poll()
    root, scene = place_lift(mine, bpy.context.scene), bpy.context.scene
    bpy.ops.plgs.show_as(kind="POINTS")  # the meshes are hidden, and still what is exported
    before = state(root)
    assert bpy.ops.plgs.export_shown(form="gltf", filepath=str(tmp_path / "room")) == {"FINISHED"}
    content = glb(tmp_path / "room.glb")
    assert {node["name"] for node in content["nodes"]} == {"floor", "chair 1"}
    assert {node["extras"]["class_id"] for node in content["nodes"]} == {FLOOR_ID, CHAIR_ID}
    assert len(content["images"]) == 2 and all(
        "baseColorTexture" in each["pbrMetallicRoughness"] for each in content["materials"]
    )
    root.plgs.instances[0].visible = False
    assert bpy.ops.plgs.export_shown(form="gltf", filepath=str(tmp_path / "hidden.glb")) == {"FINISHED"}
    assert [node["name"] for node in glb(tmp_path / "hidden.glb")["nodes"]] == ["floor"]
    root.plgs.instances[0].visible = True
    assert state(root) == before and scene.collection.children.get("PLGS export") is None
    if bpy.app.build_options.usd:
        assert bpy.ops.plgs.export_shown(form="usd", filepath=str(tmp_path / "room.usdz")) == {"FINISHED"}
        assert (tmp_path / "room.usdz").read_bytes().count(b".jpg") >= 2, "the pictures are in the file"
    with pytest.raises(RuntimeError, match="cannot be written|was not written"):
        (tmp_path / "file").touch()
        bpy.ops.plgs.export_shown(form="gltf", filepath=str(tmp_path / "file" / "room.glb"))
    assert state(root) == before


def state(root: bpy.types.Collection) -> list[object]:
    meshes = [ob for ob in root.all_objects if ob.get("plgs_key", "").startswith("mesh:")]
    of_each = [(ob.name, ob.data.materials[0].name, ob.hide_viewport, ob.visible_get()) for ob in meshes]
    return [*of_each, len(bpy.data.materials), len(bpy.data.images), len(bpy.data.collections)]


def glb(path: Path) -> dict[str, Any]:
    body = path.read_bytes()
    return json.loads(body[20 : 20 + int.from_bytes(body[12:16], "little")])


@needs_engine
def test_an_exported_depth_cloud_holds_what_a_frame_sees(lift: Path, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(lift.parent, tmp_path / "both")) / lift.name
    bpy.ops.plgs.place_lift(lift_folder=str(mine))
    scene = bpy.context.scene
    scene.plgs.lift_folder = str(mine)
    scene.camera = None
    with pytest.raises(RuntimeError, match=worded("no-camera")):
        bpy.ops.plgs.make_depth_cloud()
    frame = next(path.stem for path in sorted((mine / "result" / "passes").glob("*.exr")))
    bpy.ops.plgs.go_to_frame(frame=frame)
    assert bpy.ops.plgs.make_depth_cloud() == {"FINISHED"}
    (cloud,) = [ob for ob in scene.objects if ob.get("plgs_key") == f"depth_cloud:{frame}"]
    assert len(cloud.data.points) == cloud["points"] > 1000
    assert {"Col", "class_id", "instance_id", "confidence", "entropy"} <= {each.name for each in cloud.data.attributes}
    seen = np.array([scene.camera.matrix_world.inverted() @ point.co for point in cloud.data.points])
    across = np.abs(seen[:, 0] / seen[:, 2]) * scene.camera["fx"] / scene.camera["width"]
    assert (seen[:, 2] < 0).all() and 0.4 < across.max() <= 0.51  # before the camera, to the edges of its picture
    bpy.ops.plgs.place_lift(lift_folder=str(mine))
    assert cloud.name in scene.objects


def test_a_cancelled_export_is_not_an_error(lift: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "import time; time.sleep(600)")
    export = exports.export(lift, "coco", tmp_path, Path(sys.executable))
    assert not bpy.ops.plgs.export_lift.poll(), "one at a time"
    with raises_key("at-work"):
        exports.export(lift, "mesh", tmp_path, Path(sys.executable), asked=False)
    bpy.ops.plgs.cancel_export()
    assert export.is_taken and export.error is None and export.message == "The export was cancelled"


def test_an_export_cancels_unasked_mesh_making(lift: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "import time; time.sleep(600)")
    unasked = exports.export(lift, "mesh", tmp_path, Path(sys.executable), asked=False)
    assert bpy.ops.plgs.export_lift.poll() and unasked.is_running
    export = exports.export(lift, "coco", tmp_path, Path(sys.executable))
    assert registry.running(exports.Export) == [export] and not bpy.ops.plgs.export_lift.poll()
    registry.wait_for(unasked, bpy.context.scene)  # its engine was killed, so this returns
    assert not unasked.has_finished
    bpy.ops.plgs.cancel_export()
