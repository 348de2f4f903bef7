"""The Gaussians as squares, and what colours they have."""

from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from blender_helpers import values_of
from mathutils import Matrix
from plgs.engine.passes.ply import columns_of, write_ply_table
from plgs.engine.posed.ply import read_gaussians
from plgs.plgs_blender import lift_scene, splat_objects, splats
from plgs.plgs_blender.clouds import SurfaceGrid
from plgs.plgs_blender.inspecting import looks
from plgs.plgs_blender.inspecting.lists import registered
from plgs.plgs_blender.meshes import mesh_folder
from plgs.plgs_blender.results import result_of
from plgs.plgs_blender.reuse import make_objects
from surface_file import write_surface
from tiny_lift import mend_manifest, write_tiny_lift
from tiny_scene import CHAIR_ID

from tests.raises_key import raises_key


def write_gaussians(path: Path) -> None:
    """A flat red one in the plane z = 1, one on edge, and one that can hardly be seen."""
    n = 3
    red = np.full((n, 3), -1.0, np.float32) * [-1.7724539, 1.7724539, 1.7724539]
    turn = np.zeros((n, 4), np.float32)
    turn[:, 0], turn[1] = 1.0, (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
    columns = {
        **columns_of("x y z", np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1]], np.float32)),
        **columns_of("f_dc_0 f_dc_1 f_dc_2", red.astype(np.float32)),
        "opacity": np.array([2.0, 2.0, -6.0], np.float32),
        **columns_of("scale_0 scale_1 scale_2", np.log(np.array([[0.1, 0.2, 0.01]] * n, np.float32))),
        **columns_of("rot_0 rot_1 rot_2 rot_3", turn),
        "class_id": np.full(n, CHAIR_ID, np.int32),
        "instance_id": np.array([1, 0, 0], np.int32),
    }
    write_ply_table(path, columns)


NOWHERE = splats.Eyes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
FLOOR = np.stack([*np.meshgrid(np.linspace(-1, 3, 40), np.linspace(-1, 1, 20)), np.ones((20, 40))], axis=-1)


def floor(up: float) -> splats.SeenSurface:
    """Points in the plane z = 1, seen from above or below."""
    xyz = FLOOR.reshape(-1, 3).astype(np.float32)
    return splats.SeenSurface(SurfaceGrid.of(xyz), np.tile(np.float32([0, 0, up]), (len(xyz), 1)))


def test_splat_squares_lie_as_their_gaussians_and_face_outwards(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "gaussians.ply")
    rows = read_gaussians(tmp_path / "gaussians.ply")
    assert splats.seen(rows, 0.1).tolist() == [0, 1]
    for up in (1.0, -1.0):
        made = splats.squares(rows[:2], floor(up), NOWHERE)
        assert np.allclose(np.abs(made.right), [[0, 0.4, 0], [0, 0, 0.4]], atol=1e-6)
        assert np.allclose(np.abs(made.up), [[0.2, 0, 0], [0.2, 0, 0]], atol=1e-6)
        assert np.sign(np.cross(made.right, made.up)[0, 2]) == up
    far = rows[:1].copy()
    far["z"] = 7.0
    eyes = splats.Eyes(np.array([[0.0, 0.0, 9.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([0.9]))
    made = splats.squares(far, floor(-1.0), eyes)
    assert np.cross(made.right, made.up)[0, 2] > 0, "what lies beside no surface faces the nearest eye"
    aside = splats.Eyes(np.array([[9.0, 0.0, 8.0]]), np.array([[-1.0, 0.0, 0.0]]), np.array([0.9]))
    flat = splats.squares(far, floor(-1.0), aside)
    assert np.allclose([flat.right[0, 2], flat.up[0, 2]], 0), "a flat one lies as it does in the model"
    assert np.cross(flat.right, flat.up)[0, 2] > 0
    far["scale_2"] = far["scale_1"]
    seen = np.cross(*(getattr(splats.squares(far, floor(-1.0), aside), each)[0] for each in ("right", "up")))
    assert np.allclose(seen / np.linalg.norm(seen), np.array([9, 0, 1]) / 82**0.5), "a round one faces the eye"


def test_splats_of_objects_seen_from_both_sides_have_two_faces(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "gaussians.ply")
    rows = read_gaussians(tmp_path / "gaussians.ply")[:1]
    wall = rows.copy()
    wall["instance_id"] = 0
    down, up = [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]

    def normals(row: np.ndarray, *cameras: tuple[float, list[float]]) -> list[float]:
        places = np.array([[0.0, 0.0, height] for height, _ in cameras])
        eyes = splats.Eyes(places, np.array([ahead for _, ahead in cameras]), np.full(len(cameras), 0.9))
        made = splats.squares(row, floor(1.0), eyes)
        assert len(made.ids["class_id"]) == len(made.xyz) == len(made.opacity) == len(made.rgb)
        return np.sign(np.cross(made.right, made.up)[:, 2]).tolist()

    assert normals(rows, (2.0, down)) == normals(rows, (2.0, down), (-9.0, down)) == [1.0]
    assert normals(rows, (2.0, down), (-9.0, up)) == [1.0, -1.0]
    assert normals(wall, (2.0, down), (-9.0, up)) == [1.0], "walls and ceilings are open from behind"


@pytest.fixture
def lift(tmp_path: Path) -> Path:
    lift = write_tiny_lift(tmp_path / "lift", frames=4, bake=False).path
    write_gaussians(lift / "result" / "gaussians.ply")
    mend_manifest(lift)
    return lift


def evaluated() -> Any:
    """The data of the splats as Blender draws them."""
    return bpy.data.objects["Gaussians"].evaluated_get(bpy.context.evaluated_depsgraph_get()).data


@pytest.mark.skipif(splat_objects.are_known(), reason="this Blender has splats of its own")
def test_each_gaussian_is_drawn_as_one_square(lift: Path) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    drawn = evaluated()
    assert len(drawn.polygons) == 2 and drawn.color_attributes.active_color.name == "Col"
    corners = np.unique(values_of(drawn, "corner", "vector", 3), axis=0)
    assert sorted(map(tuple, corners)) == [(x, y, 0.0) for x in (-2.0, 2.0) for y in (-2.0, 2.0)]


@pytest.mark.skipif(not splat_objects.are_known(), reason="only Blender 5.3 and later have splats of their own")
def test_splats_match_those_of_blenders_own_importer(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    ours = bpy.data.objects["Gaussians"].data
    bpy.ops.wm.ply_import(filepath=str(lift / "result" / "gaussians.ply"))
    theirs = bpy.context.object.data
    assert ours.type == theirs.type == "GAUSSIAN_SPLAT" and len(ours.points) == 2 == len(theirs.points) - 1
    base_of = partial(values_of, name="radiance:base", key="vector", width=4)
    assert base_of(ours) == pytest.approx(base_of(theirs)[:2], abs=1e-5)
    for column in (("position", "vector", 3), ("scale", "vector", 3), ("rotation", "value", 4)):
        assert values_of(ours, *column) == pytest.approx(values_of(theirs, *column)[:2], abs=1e-5), column
    with registered():
        root.plgs.look = "INSTANCES"
        base, colour = base_of(ours), values_of(ours, "Col", "color_srgb", 4)
        assert 0.5 + 0.28209479 * base[:, :3] == pytest.approx(colour[:, :3], abs=1e-5)
        assert base[:, 3] == pytest.approx(base_of(theirs)[:2, 3]), "as opaque as before"
        root.plgs.instances[0].visible = False
        assert evaluated().type == "GAUSSIAN_SPLAT" and len(evaluated().points) == 1


@pytest.mark.skipif(not splat_objects.are_known(), reason="only Blender 5.3 and later have splats of their own")
def test_native_splats_of_a_wall_are_not_drawn_from_behind(lift: Path) -> None:
    lift_scene.place_lift(lift, bpy.context.scene)
    normal = values_of(bpy.data.objects["Gaussians"].data, "normal", "vector", 3)
    assert not normal[0].any(), "what belongs to an object is always shown"
    camera = bpy.context.scene.camera
    for side, count in ((1.0, 2), (-1.0, 1)):
        camera.matrix_world = Matrix.Translation(np.float32([1, 0, 1]) + 3.0 * side * normal[1])
        bpy.context.view_layer.update()
        assert len(evaluated().points) == count


def test_splats_placed_again_have_the_new_colours_and_hidden_objects(lift: Path) -> None:
    with registered():
        root = lift_scene.place_lift(lift, bpy.context.scene)
        root.plgs.look = "INSTANCES"
        make_objects(root, [1], as_assets=False)  # what the lift shows of it is hidden
        path = lift / "result" / "gaussians.ply"
        rows = read_gaussians(path)[[1, 1, 0]].copy()
        rows["f_dc_1"], rows["f_dc_0"] = 1.7724539, -1.7724539  # green
        write_ply_table(path, {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names})
        mend_manifest(lift)
        root = lift_scene.place_lift(lift, bpy.context.scene)
        data = bpy.data.objects["Gaussians"].data
        assert values_of(data, "plgs_hidden").tolist() == [False, False, True]
        root.plgs.look = "PHOTO"
        assert values_of(data, "Col", "color", 4) == pytest.approx(np.tile([0.0, 1.0, 0.0, 1.0], (3, 1)), abs=1e-3)


def test_splats_that_another_blender_made_are_replaced(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    made = bpy.data.objects["Gaussians"]
    data = (bpy.data.meshes if splat_objects.are_known() else bpy.data.pointclouds).new("Gaussians")
    other = bpy.data.objects.new("Gaussians", data)
    made.users_collection[0].objects.link(other)
    for block in (other, data):
        for name in ("plgs_lift", "plgs_key"):
            block[name] = made[name]
    bpy.data.objects.remove(made)
    with registered():
        lift_scene.show_lift_as(root, bpy.context.scene, "SPLATS")
    (found,) = [ob for ob in bpy.data.objects if ob.name.startswith("Gaussians")]
    assert len(found.data.attributes["position"].data) == 2
    assert found.type == ("POINTCLOUD" if splat_objects.are_known() else "MESH")


def test_a_lift_opens_as_splats_that_can_be_recoloured(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    data = bpy.data.objects["Gaussians"].data
    shown = {each.name: not each.hide_viewport for each in root.children}
    assert shown["Gaussians"] and not shown["Semantic points"]

    def colours() -> np.ndarray:
        return values_of(data, "Col", "color", 4)

    photo = colours()
    assert photo == pytest.approx(np.tile([1.0, 0.0, 0.0, 1.0], (2, 1)), abs=1e-3)
    with registered():
        root.plgs.look = "INSTANCES"
        own = bpy.data.objects[next(ob.name for ob in root.all_objects if ob.get("plgs_key") == "instance:1")].color
        assert colours()[0] == pytest.approx([*own], abs=5e-3) and np.ptp(colours()[1, :3]) < 1e-6
        root.plgs.look = "CLASSES"
        assert colours()[1] == pytest.approx([*bpy.data.objects["chair points"].color], abs=5e-3)
        classes = colours()
        root.plgs.look = "UNCERTAINTY"
        assert not np.allclose(colours(), photo) and not np.allclose(colours(), classes)
        root.plgs.look = "PHOTO"
        assert np.array_equal(colours(), photo)
        lift_scene.show_lift_as(root, bpy.context.scene, "POINTS")
        assert bpy.data.objects["Gaussians"].users_collection[0].hide_render
        with raises_key("no-meshes"):
            lift_scene.show_lift_as(root, bpy.context.scene, "SURFACE")
    lift_scene.place_lift(lift, bpy.context.scene)
    assert [ob.name for ob in bpy.data.objects if ob.name.startswith("Gaussians")] == ["Gaussians"]


def test_splats_of_a_lift_with_a_mesh_are_made_only_on_request(lift: Path, extension: None) -> None:
    """They would take a quarter of the saved file."""
    scene = bpy.context.scene
    root = lift_scene.place_lift(lift, scene)
    assert looks.has(root, "SPLATS") and root.plgs.show_as == "SPLATS"
    write_surface(mesh_folder(lift) / "mesh.ply")
    assert result_of(lift_scene.placing_meshes_anew(lift, scene, asked=False)) == 2
    assert not looks.has(root, "SPLATS") and root.plgs.show_as == "SURFACE"
    for kind in ("SPLATS", "SURFACE", "SPLATS"):
        assert bpy.ops.plgs.show_as(kind=kind) == {"FINISHED"}
        assert looks.has(root, "SPLATS") and root.plgs.show_as == kind
    lift_scene.place_lift(lift, scene)
    assert looks.has(root, "SPLATS"), "they are shown"
    root.plgs.show_as = "SURFACE"
    lift_scene.place_lift(lift, scene)
    assert not looks.has(root, "SPLATS")
