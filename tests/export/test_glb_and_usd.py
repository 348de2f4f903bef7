"""Exports that hold a whole scene in one file, read back by Blender and by OpenUSD."""

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from engine.command_line.main import main
from engine.export.mesh import MOST_INSTANCES, label_names
from engine.export.source import FinishedLift
from engine.job import LiftFolder
from engine.scene import Category, ClassTable
from engine.scene_of_lift import scene_of_lift
from tests.conftest import HAS_BLENDER
from tests.export.conftest import run

READ_BY_BLENDER = """
import json, sys
import bpy
found = {}
for path in sys.argv[1:]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    read = bpy.ops.wm.usd_import if path.endswith(".usdc") else bpy.ops.import_scene.gltf
    read(filepath=path)
    found[path] = objects = {}
    for ob in bpy.data.objects:
        told = objects[ob.name] = {"type": ob.type, "matrix": [list(row) for row in ob.matrix_world]}
        if ob.type == "MESH":
            told["vertices"] = [list(ob.matrix_world @ vertex.co) for vertex in ob.data.vertices]
            images = [n.image for m in ob.data.materials for n in m.node_tree.nodes if n.type == "TEX_IMAGE"]
            told["materials"] = [material.name for material in ob.data.materials]
            told["pictures"] = [list(image.size) for image in images if image is not None]
            told["uv"] = len(ob.data.uv_layers)
            told["class"] = ob.get("class")
        if ob.type == "CAMERA":
            data = ob.data
            told["lens"] = [data.lens, data.sensor_width, data.sensor_height, data.shift_x, data.shift_y]
print("FOUND" + json.dumps(found))
"""


def read_by_blender(*paths: Path) -> dict[str, Any]:
    """What Blender's own importers make of the files, in a process of its own: OpenUSD is here already."""
    command = [sys.executable, "-c", READ_BY_BLENDER, *map(str, paths)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True).stdout
    return json.loads(said.rpartition("FOUND")[2])


def test_gltf_and_usd_exports_hold_all_meshes_in_one_file(lift: LiftFolder, tmp_path: Path) -> None:
    """glTF and OpenUSD, read back by Open3D, by OpenUSD and by Blender."""
    open3d, usd = pytest.importorskip("open3d"), pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdSemantics, UsdShade

    for form in ("mesh", "gltf", "usd"):
        run(lift, form, tmp_path / form)
    alone = {path.stem: open3d.io.read_triangle_mesh(str(path)) for path in (tmp_path / "mesh/meshes").iterdir()}
    joined = open3d.io.read_triangle_mesh(str(tmp_path / "gltf/lift.glb"))
    assert len(joined.triangles) == sum(len(each.triangles) for each in alone.values()) > 1000
    stage = usd.Stage.Open(str(tmp_path / "usd/lift.usdc"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    lifted = FinishedLift(lift, ["all"])
    listed = sorted(lifted.listed, key=lambda one: one.id)
    class_of = {one.name: one.class_name for one in listed}
    assert complaints(stage) == []
    in_usd: dict[str, UsdGeom.Mesh] = {}
    for prim in prims_of(stage, UsdGeom.Mesh):
        labels = {each: UsdSemantics.LabelsAPI(prim, each).GetLabelsAttr().Get() for each in ("class", "instance")}
        name = prim.GetDisplayName()
        assert list(labels["class"]) == [class_of.get(name, name)]
        assert labels["instance"] is None if name not in class_of else list(labels["instance"]) == [name]
        in_usd[name] = UsdGeom.Mesh(prim)
        number = next((f"object_{one.id}" for one in lifted.listed if one.name == name), None)
        component = prim.GetParent()
        assert number in (None, component.GetName()) and component.GetDisplayName() == name
        assert usd.ModelAPI(component).GetKind() == "component" and component.IsModel()
        assert UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    assert in_usd.keys() == alone.keys() and any(name in class_of for name in in_usd)
    for name, mesh in in_usd.items():
        upright = np.asarray(alone[name].vertices) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        points = np.array(mesh.GetPointsAttr().Get())  # Open3D changes their order
        assert are_same_places(points, upright)  # seams double vertices in glTF
    boxes = [UsdGeom.Cube(prim) for prim in prims_of(stage, UsdGeom.Cube)]
    boxes.sort(key=lambda box: int(box.GetPrim().GetName().split("_")[1]))
    assert [box.GetPrim().GetDisplayName() for box in boxes] == [one.name for one in listed]
    for box, one in zip(boxes, listed, strict=True):
        corner = np.array(box.ComputeLocalToWorldTransform(usd.TimeCode.Default()).Transform((0.5, 0.5, 0.5)))
        turn = np.array([[np.cos(one.yaw), -np.sin(one.yaw), 0], [np.sin(one.yaw), np.cos(one.yaw), 0], [0, 0, 1]])
        np.testing.assert_allclose(corner, one.centre + turn @ np.array(one.size) / 2, atol=1e-4)
    if HAS_BLENDER:
        check_in_blender(lifted, in_usd, tmp_path)


def prims_of(stage: Any, kind: Any) -> list[Any]:
    return [prim for prim in stage.Traverse() if prim.IsA(kind)]


def complaints(stage: Any) -> list[str]:
    """What usdchecker says of a stage: it runs all of OpenUSD's validators."""
    validation = pytest.importorskip("pxr.UsdValidation")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetErrorAsString() for error in validation.ValidationContext(validators).Validate(stage)]


def are_same_places(some: Any, others: Any) -> bool:
    """Whether each of some places [N, 3] is one of the others [M, 3], and the other way round."""
    return all(cKDTree(a).query(b)[0].max() < 1e-4 for a, b in ((some, others), (others, some)))


def check_in_blender(lifted: FinishedLift, meshes: Mapping[str, Any], folder: Path) -> None:
    glb, usdc = folder / "gltf/lift.glb", folder / "usd/lift.usdc"
    found = read_by_blender(glb, usdc)
    for path in (glb, usdc):
        for name, mesh in meshes.items():
            told = found[str(path)][name if path == glb else mesh.GetPrim().GetName()]
            points = np.array(mesh.GetPointsAttr().Get())
            assert path != glb or told["materials"] == [name]
            assert told["uv"] == 1 and len(told["pictures"]) == 1 and min(told["pictures"][0]) > 1
            assert are_same_places(told["vertices"], points)
    assert found[str(glb)]["floor"]["class"] == "floor"
    for frame in lifted.frames:
        told, camera = found[str(usdc)][f"camera_{frame.name}"], frame.camera
        lens, width, _, shift_x, shift_y = told["lens"]
        pose = np.array(told["matrix"]) @ np.diag([1, -1, -1, 1])
        np.testing.assert_allclose(pose, camera.camera_to_world, atol=1e-4)
        assert lens / width * camera.width == pytest.approx(camera.fx, rel=1e-4)
        assert shift_x * camera.width == pytest.approx(camera.width / 2 - camera.cx, abs=1e-2)
        assert shift_y * camera.width == pytest.approx(camera.cy - camera.height / 2, abs=1e-2)


def test_usd_holds_gaussians_and_cameras(lift: LiftFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usd = pytest.importorskip("pxr.Usd")
    from pxr import Gf, UsdGeom, UsdSemantics, UsdVol

    monkeypatch.setattr("engine.export.source.scene_of_lift", lambda of: replace(scene_of_lift(of), fps=23.976))
    run(lift, "usd", tmp_path)
    stage = usd.Stage.Open(str(tmp_path / "lift.usdc"))
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24000 / 1001
    lifted = FinishedLift(lift, ["all"])
    rows = lifted.splats
    seen = 0
    for prim in prims_of(stage, UsdVol.ParticleField3DGaussianSplat):
        field = UsdVol.ParticleField3DGaussianSplat(prim)
        assert field and field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
        assert usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Get() == "srgb_rec709_display"
        of = {each: UsdSemantics.LabelsAPI(prim, each).GetLabelsAttr().Get() for each in ("class", "instance")}
        names = lifted.instances.names
        own = np.array([names.get(each, "") for each in rows["instance_id"].tolist()]) == (of["instance"] or [""])[0]
        classes = {each.id: each.name for each in lifted.classes.categories}
        own &= np.array([classes.get(each, "") for each in rows["class_id"].tolist()]) == (of["class"] or [""])[0]
        mine = rows[own]
        seen += len(mine)
        xyz = np.stack([mine[axis] for axis in "xyz"], axis=1)
        np.testing.assert_array_equal(np.array(field.GetPositionsAttr().Get()), xyz)
        scales = np.stack([mine[f"scale_{axis}"] for axis in range(3)], axis=1)
        np.testing.assert_allclose(np.log(np.array(field.GetScalesAttr().Get())), scales, atol=1e-4)
        opacity = np.array(field.GetOpacitiesAttr().Get(), np.float64)
        np.testing.assert_allclose(opacity, 1 / (1 + np.exp(-mine["opacity"].astype(np.float64))), atol=1e-6)
        turn = field.GetOrientationsAttr().Get()[0]
        quat = np.array([mine[f"rot_{part}"][0] for part in range(4)])
        np.testing.assert_allclose([turn.real, *turn.imaginary], quat / np.linalg.norm(quat), atol=1e-5)
        colours = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
        np.testing.assert_array_equal(colours[:, 1], mine["f_dc_1"])
    assert seen == len(rows) > 0
    camera = lifted.frames[0].camera
    moving = UsdGeom.Camera.Get(stage, "/Lift/Cameras/moving")
    for frame in lifted.frames:
        still = UsdGeom.Camera.Get(stage, f"/Lift/Cameras/camera_{frame.name}")
        assert moving.GetCamera(int(frame.name)) == still.GetCamera(usd.TimeCode.Default())
    assert stage.GetEndTimeCode() == max(int(frame.name) for frame in lifted.frames)
    frustum = UsdGeom.Camera.Get(stage, f"/Lift/Cameras/camera_{lifted.frames[0].name}").GetCamera().frustum
    point = camera.camera_to_world @ np.array([0.3, -0.2, 2.0, 1.0])
    (pixel,), _ = camera.project(point[None, :3])
    shown = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    x, y, _ = shown.Transform(Gf.Vec3d(*point[:3]))
    assert ((x + 1) / 2 * camera.width, (1 - y) / 2 * camera.height) == pytest.approx(tuple(pixel), abs=1e-3)


def test_time_stamps_in_frame_names_are_not_taken_for_frame_numbers() -> None:
    pytest.importorskip("pxr")
    from engine.export.usd import ascending_numbers

    assert ascending_numbers(["frame-0010", "frame-0012"]) == [10.0, 12.0]
    assert ascending_numbers(["1305031102.95", "1305031103.05"]) == ascending_numbers(["1", "last"]) == []


def test_a_usd_export_names_the_missing_package(
    lift: LiftFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("engine.export.run.find_spec", lambda name: None)
    assert main(["export", str(lift.path), "--to", "usd", "-o", str(tmp_path / "out")]) != 0
    assert "engine add usd" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("letter", ["a", "\N{PILE OF POO}", "/"])
def test_an_object_name_too_long_for_a_file_name_is_shortened(letter: str) -> None:
    classes = ClassTable((Category(1, "chair", True, (1, 2, 3)),))
    labels = np.array([MOST_INSTANCES + 1, MOST_INSTANCES + 2])
    names = [*label_names(labels, classes, {1: 300 * letter, 2: 300 * letter + "b"}).values()]
    assert len({*names}) == 2 and max(len(f".part-{name}.ply".encode()) for name in names) <= 255
