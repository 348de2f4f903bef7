"""The lifted surface in Blender: real meshes, labelled, found again, and exported by Blender."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from plgs.engine.corrections import correct, making
from plgs.engine.posed.ply import read_surface
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.inspecting.lists import registered
from plgs.plgs_blender.inspecting.selection import boxes_of, follow_name
from plgs.plgs_blender.materials import PICTURE, image_of, value_node
from plgs.plgs_blender.meshes import are_stale, mesh_folder
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.results import result_of
from surface_file import SIDE, write_surface
from tiny_scene import CHAIR_ID, FLOOR_ID

from tests.raises_key import raises_key


@pytest.fixture
def lift(lift: Path, tmp_path: Path) -> Path:
    """A copy with the surface of a floor of 4 by 3 m, on which a patch of 1 by 1 m is the chair."""
    path = Path(shutil.copytree(lift, tmp_path / "lift"))
    write_surface(mesh_folder(path) / "mesh.ply")
    return path


def placed(lift: Path) -> dict[str, bpy.types.Object]:
    lift_scene.place_lift(lift, bpy.context.scene)
    (root,) = lifts_in(bpy.context.scene)
    (top,) = [child for child in root.children if child.name == "Meshes"]
    assert sorted(child.name for child in top.children) == ["chair meshes", "floor meshes"]
    return {ob["plgs_key"]: ob for ob in top.all_objects}


def place_anew(lift: Path, *, asked: bool = True) -> int:
    return result_of(lift_scene.placing_meshes_anew(lift, bpy.context.scene, asked=asked))


def test_a_mesh_made_later_is_placed_hidden_if_points_are_shown(lift: Path) -> None:
    path = mesh_folder(lift) / "mesh.ply"
    path.rename(path.with_suffix(".later"))
    root = lift_scene.place_lift(lift, bpy.context.scene)
    path.with_suffix(".later").rename(path)
    seen = []
    for _ in lift_scene.placing_meshes_anew(lift, bpy.context.scene):
        shown = {child.name: not child.hide_viewport for child in root.children}
        seen.append((shown["Semantic points"], shown.get("Meshes", False)))
    assert {*seen} == {(True, False)}
    assert next(child for child in root.children if child.name == "Semantic points").hide_viewport


def test_one_mesh_per_instance_and_per_stuff_class(lift: Path) -> None:
    objects = placed(lift)
    assert set(objects) == {f"mesh:{CHAIR_ID}:1", f"mesh:{FLOOR_ID}:0"}
    for key, name, area, label in (
        (f"mesh:{CHAIR_ID}:1", "chair 1", 1.0, (CHAIR_ID, 1)),
        (f"mesh:{FLOOR_ID}:0", "floor", 12.0, (FLOOR_ID, 0)),
    ):
        ob = objects[key]
        mesh = ob.data
        assert (ob.name, mesh.name) == (name, name) and (ob["class_id"], ob["instance_id"]) == label
        assert sum(polygon.area for polygon in mesh.polygons) == pytest.approx(area, rel=1e-5)
        assert all(polygon.normal.z > 0.99 for polygon in mesh.polygons)
        assert (len(mesh.vertices), len(mesh.polygons)) == (SIDE**2, 2 * (SIDE - 1) ** 2)
        for attribute, value in zip(("class_id", "instance_id"), label, strict=True):
            assert {each.value for each in mesh.attributes[attribute].data} == {value}
        assert mesh.color_attributes.active_color.name == "Col"
        assert np.allclose(mesh.color_attributes["Col"].data[0].color, (1.0, 0.2158605, 0.0, 1.0), atol=1e-4)


def test_meshes_show_their_textures_only_in_photo_colours(lift: Path) -> None:
    pytest.importorskip("scipy", reason="the engine, which makes the pictures, runs in another Python")
    write_surface(mesh_folder(lift) / "mesh.ply", 40)
    floor = placed(lift)[f"mesh:{FLOOR_ID}:0"]
    mesh, image = floor.data, image_of(floor.data.materials[0])
    for loop, place in zip(mesh.loops, mesh.uv_layers[0].uv, strict=True):
        assert np.allclose(mesh.vertices[loop.vertex_index].co[:2], np.array(place.vector) * (4, 3), atol=1e-5)
    assert len({each.data.materials[0] for each in placed(lift).values()}) == 2
    assert tuple(image.size) == (64, 32) and image.pixels[0] == pytest.approx(40 / 255, abs=0.02)
    share = value_node(mesh.materials[0], PICTURE).outputs[0]
    (root,) = lifts_in(bpy.context.scene)
    with registered():
        for look, seen in (("CLASSES", 0.0), ("PHOTO", 1.0)):
            root.plgs.look = look
            assert share.default_value == seen
    write_surface(mesh_folder(lift) / "mesh.ply", 200)
    assert place_anew(lift) == 2 and image.pixels[0] == pytest.approx(200 / 255, abs=0.02)
    write_surface(mesh_folder(lift) / "mesh.ply")
    assert place_anew(lift) == 2 and image_of(floor.data.materials[0]) is None


def test_the_mesh_catches_shadows_of_objects_put_into_the_room(lift: Path, tmp_path: Path) -> None:
    floor, scene = placed(lift)[f"mesh:{FLOOR_ID}:0"], bpy.context.scene
    (root,) = lifts_in(scene)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 3.0, (0.0, np.radians(30.0), 0.0)  # light falls from +x to -x
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(3.0, 1.5, 0.3))
    eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    eye.location = (2.0, 1.5, 6.0)
    scene.timeline_markers.clear()  # which bind the frames' cameras
    for ob in (sun, eye):
        scene.collection.objects.link(ob)
    scene.camera, scene.render.engine, scene.cycles.samples = eye, "CYCLES", 16
    scene.cycles.use_denoising, scene.render.image_settings.color_mode = False, "RGBA"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.filepath = 48, 36, str(tmp_path / "seen.png")
    for child in root.children:
        child.hide_render = child.name != "Meshes"
    own = floor.material_slots[0].material
    with registered():
        root.plgs.catch_shadows = True
        assert floor.is_shadow_catcher and not floor.visible_shadow and scene.render.film_transparent
        bpy.ops.render.render(write_still=True)
        seen = bpy.data.images.load(scene.render.filepath)
        alpha = np.array(seen.pixels).reshape(36, 48, 4)[..., 3]
        row, column = round(36 / 2), lambda x: round(24 + 48 * (x - 2.0) / 6.0 / 36 * 50)
        assert alpha[row, column(3.0)] > 0.95 and alpha[row, column(2.55)] > 0.3 > alpha[row, column(1.2)] + 0.2
        root.plgs.catch_shadows = False
    assert floor.material_slots[0].material == own and not floor.is_shadow_catcher and floor.visible_shadow


def test_placing_meshes_again_reuses_their_objects(lift: Path) -> None:
    before = {key: ob.as_pointer() for key, ob in placed(lift).items()}
    assert {key: ob.as_pointer() for key, ob in placed(lift).items()} == before
    assert place_anew(lift) == 2
    (mesh_folder(lift) / "mesh.ply").unlink()
    lift_scene.place_lift(lift, bpy.context.scene)
    assert not [ob for ob in bpy.context.scene.objects if ob.get("plgs_key", "").startswith("mesh:")]


def test_the_mesh_of_a_deleted_object_goes_with_the_next_mesh_export(lift: Path) -> None:
    chair = next(ob for ob in placed(lift).values() if ob["instance_id"])
    correct(lift, lambda state, _: making.delete(state, chair["instance_id"], around=False))
    name = chair.name
    place_anew(lift)
    assert name not in bpy.data.objects


def test_a_mesh_made_automatically_is_shown_unless_another_view_was_chosen(lift: Path) -> None:
    path = mesh_folder(lift) / "mesh.ply"
    surface = path.read_bytes()
    path.unlink()
    root, scene = lift_scene.place_lift(lift, bpy.context.scene), bpy.context.scene
    with registered():
        before = root.plgs.show_as
        path.write_bytes(surface)
        place_anew(lift, asked=False)
        assert before != root.plgs.show_as == "SURFACE"
        lift_scene.show_lift_as(root, scene, before)
        place_anew(lift, asked=False)
        assert root.plgs.show_as == before
        place_anew(lift)
        assert root.plgs.show_as == "SURFACE"


def test_blender_itself_exports_the_meshes(lift: Path, tmp_path: Path) -> None:
    objects = placed(lift)
    for ob in bpy.context.scene.objects:
        ob.select_set(ob in objects.values())
    bpy.ops.export_scene.gltf(filepath=str(tmp_path / "room.glb"), use_selection=True, export_attributes=True)
    bpy.ops.wm.usd_export(filepath=str(tmp_path / "room.usdc"), selected_objects_only=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "room.glb"))
    meshes = [ob.data for ob in bpy.data.objects if ob.type == "MESH"]
    assert [len(mesh.polygons) for mesh in meshes] == [2 * (SIDE - 1) ** 2] * 2
    assert all(mesh.color_attributes for mesh in meshes)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.usd_import(filepath=str(tmp_path / "room.usdc"))
    meshes = [ob.data for ob in bpy.data.objects if ob.type == "MESH"]
    assert [len(mesh.polygons) for mesh in meshes] == [2 * (SIDE - 1) ** 2] * 2
    assert {value.value for mesh in meshes for value in mesh.attributes["class_id"].data} == {CHAIR_ID, FLOOR_ID}


def test_a_damaged_mesh_file_gives_a_one_line_error(lift: Path) -> None:
    path = mesh_folder(lift) / "mesh.ply"
    whole = path.read_bytes()
    for content in (whole[:-3], whole.replace(b"class_id", b"klass_id"), b"", b"ply\n"):
        path.write_bytes(content)
        with raises_key("file-damaged|not-labelled-surface"):
            read_surface(path)


def test_renaming_an_object_renames_its_mesh(lift: Path, extension: None) -> None:
    objects = placed(lift)
    (root,) = lifts_in(bpy.context.scene)
    chair = objects[f"mesh:{CHAIR_ID}:1"]
    assert bpy.ops.plgs.rename_instance(instance=1, name="throne") == {"FINISHED"}
    assert (chair.name, chair.data.name) == ("throne", "throne") and not are_stale(root)
    lift_scene.place_lift(lift, bpy.context.scene)
    assert chair.name == "throne" and boxes_of(root)[1].name == "throne box" and not are_stale(root)
    bpy.context.view_layer.objects.active, chair.name = chair, "stool"  # as the outliner does
    follow_name()
    assert root.plgs.instances[0].name == chair.data.name == "stool" and boxes_of(root)[1].name == "stool box"
    assert bpy.ops.plgs.reclass_instances(instances="1", class_name="cabinet") == {"FINISHED"}
    assert are_stale(root)
