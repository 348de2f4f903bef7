"""Objects of a lift as collections of their own: their parts, where they stand, the hole, assets, and keys."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from blender_helpers import values_of
from mathutils import Vector
from plgs.engine.corrections import read_corrected
from plgs.plgs_blender import corrections, lift_scene
from plgs.plgs_blender.inspecting.looks import HIDDEN
from plgs.plgs_blender.inspecting.selection import boxes_of, clouds_of, ids_of, surfaces_of
from plgs.plgs_blender.materials import image_of
from plgs.plgs_blender.meshes import mesh_folder
from surface_file import write_surface

from tests.corrections.test_removal import patch, removal
from tests.raises_key import worded
from tests.tiny_scene import FLOOR_ID

CHAIR, CABINET = 1, 2


@pytest.fixture
def mine(mine: Path) -> Path:
    write_surface(mesh_folder(mine) / "mesh.ply")
    return mine


def hidden(placed: bpy.types.Collection, instance: int) -> bool:
    """Whether all points of an instance in the lift's own clouds are hidden."""
    for cloud in clouds_of(placed):
        own = ids_of(cloud.data, "instance_id") == instance
        if "class_id" in cloud and own.any():
            return HIDDEN in cloud.data.attributes and bool(values_of(cloud.data, HIDDEN)[own].all())
    raise AssertionError("it has no points")


def test_a_made_object_stands_on_its_foot_and_is_hidden_in_the_lift(placed: bpy.types.Collection, mine: Path) -> None:
    before = {ob.name for ob in bpy.data.objects}
    assert bpy.ops.plgs.make_objects(instances=str(CHAIR)) == {"FINISHED"}
    made = bpy.data.collections["chair 1"]
    assert {ob.name for ob in bpy.data.objects} - before == {"chair 1 points", "chair 1 surface"}
    assert not [name for name in (ob.name for ob in bpy.data.objects) if ".0" in name]
    one = next(each for each in read_corrected(mine).instances if each.id == CHAIR)
    foot = Vector(one.centre) - Vector((0, 0, one.size[2] / 2))
    surface, points = (bpy.data.objects[f"chair 1 {part}"] for part in ("surface", "points"))
    bpy.context.view_layer.update()
    assert np.allclose(surface.matrix_world.translation, foot, atol=1e-5)
    assert np.allclose(made.instance_offset, foot, atol=1e-5)
    assert points.parent == surface and points.hide_viewport and points.hide_render and not surface.hide_render
    assert bpy.context.selected_objects == [surface] == [bpy.context.view_layer.objects.active]
    assert not surface.data.materials[0].use_backface_culling and "plgs_lift" not in surface.data
    xyz = np.array([surface.matrix_world @ point.co for point in points.data.points])
    result = read_corrected(mine).points
    assert np.allclose(np.sort(xyz, axis=0), np.sort(result.xyz[result.instance_id == CHAIR], axis=0), atol=1e-4)
    assert {"Col", "confidence", "entropy", "normal", "radius"} <= {each.name for each in points.data.attributes}
    assert hidden(placed, CHAIR) and not hidden(placed, CABINET)


def test_a_made_object_keeps_its_texture_when_the_lift_is_deleted(placed: bpy.types.Collection, mine: Path) -> None:
    write_surface(mesh_folder(mine) / "mesh.ply", 40)
    lift_scene.place_lift(mine, bpy.context.scene)
    assert bpy.ops.plgs.make_objects(instances=str(CHAIR)) == {"FINISHED"}
    surface = bpy.data.objects["chair 1 surface"]
    image = image_of(surface.data.materials[0])
    assert image.packed_file is not None and "plgs_lift" not in image and len(surface.data.uv_layers) == 1
    write_surface(mesh_folder(mine) / "mesh.ply", 200)
    lift_scene.place_lift(mine, bpy.context.scene)
    assert image.pixels[0] == pytest.approx(40 / 255, abs=0.02)


def test_a_made_object_can_be_a_shadow_catcher(placed: bpy.types.Collection) -> None:
    assert bpy.ops.plgs.make_objects(instances=str(CHAIR), catch_shadows=True) == {"FINISHED"}
    surface = bpy.data.objects["chair 1 surface"]
    assert surface.is_shadow_catcher and not surface.visible_shadow
    assert surface.material_slots[0].material.name == "PLGS shadow catcher"
    assert bpy.ops.plgs.make_objects(instances=str(CHAIR)) == {"FINISHED"}
    assert not bpy.data.objects["chair 1 surface"].is_shadow_catcher


def test_making_an_object_again_keeps_its_moved_position(placed: bpy.types.Collection, mine: Path) -> None:
    bpy.ops.plgs.make_objects(instances="all")
    pivot = bpy.data.objects["chair 1 surface"]
    pivot.location.x += 2.0
    bpy.context.view_layer.update()
    where = pivot.matrix_world.copy()
    lift_scene.place_lift(mine, bpy.context.scene)
    assert bpy.data.objects["chair 1 surface"].matrix_world == where and hidden(placed, CHAIR)  # no lift touches it
    bpy.ops.plgs.make_objects(instances=str(CHAIR))
    bpy.context.view_layer.update()
    assert np.allclose(bpy.data.objects["chair 1 surface"].matrix_world, where)
    assert "chair 1.001" not in bpy.data.collections and len(bpy.data.collections["chair 1"].objects) == 2


def test_objects_made_as_assets_have_a_preview_picture(placed: bpy.types.Collection) -> None:
    bpy.ops.plgs.make_objects(instances=str(CHAIR), as_assets=True)
    made = bpy.data.collections["chair 1"]
    assert made.asset_data is not None and "chair" in {tag.name for tag in made.asset_data.tags}
    pixels = np.array(made.preview.image_pixels_float).reshape(128, 128, 4)
    assert 0.1 < (pixels[..., 3] > 0).mean() < 0.95 and pixels[..., :3].max() > 0.1


def test_a_made_object_is_visible_only_in_frames_that_show_it(placed: bpy.types.Collection) -> None:
    scene = bpy.context.scene
    (row,) = [row for row in placed.plgs.instances if row.instance_id == CHAIR]
    shown = {mask.frame for mask in row.masks}
    markers = {marker.name: marker.frame for marker in scene.timeline_markers if marker.camera is not None}
    row.masks.remove(0)
    lost = (shown - {mask.frame for mask in row.masks}).pop()
    assert bpy.ops.plgs.key_visibility(instances=str(CHAIR)) == {"FINISHED"}
    for name, frame in markers.items():
        scene.frame_set(frame)
        box, mesh = boxes_of(placed)[CHAIR], next(ob for ob in placed.all_objects if ob.name == "chair 1")
        assert box.hide_viewport == mesh.hide_viewport == mesh.hide_render == (name not in shown or name == lost)
        assert box.hide_render
    row.masks.clear()
    with pytest.raises(RuntimeError, match="[Nn]o frame shows instance 1"):
        bpy.ops.plgs.key_visibility(instances=str(CHAIR))


def test_a_removed_object_can_still_be_made_from_its_surface(mine: Path) -> None:
    write_surface(mesh_folder(mine) / "mesh.ply", 40)
    placed, floor = lift_scene.place_lift(mine, bpy.context.scene), np.float32([[1.3, 1.1, 0], [1.5, 1.3, 0]])
    removal(mine, CHAIR, fill=patch(floor, -FLOOR_ID))
    corrections.show_corrections(placed, read_corrected(mine))
    own = next(ob for ob in surfaces_of(placed) if ob.get("instance_id") == CHAIR)
    assert values_of(own.data, HIDDEN).all(), "the lift's own mesh is older than the removal"
    assert bpy.ops.plgs.make_objects(instances=str(CHAIR)) == {"FINISHED"}
    surface = bpy.data.objects["chair 1 surface"]
    assert image_of(surface.data.materials[0]).packed_file is not None and HIDDEN not in surface.data.attributes
    filled = [np.array([point.co[:] for point in cloud.data.points]) for cloud in clouds_of(placed)]
    assert min(np.abs(xyz - floor[1]).max(axis=1).min() for xyz in filled) < 1e-4
    assert bpy.ops.plgs.put_back(instance=CHAIR) == {"FINISHED"}
    assert any(row.instance_id == CHAIR for row in placed.plgs.instances)


def test_making_a_removed_object_without_surface_says_what_to_do(mine: Path) -> None:
    removal(mine, CABINET, fill=patch(np.float32([[1.3, 1.1, 0]]), -FLOOR_ID))
    lift_scene.place_lift(mine, bpy.context.scene)
    with pytest.raises(RuntimeError, match=worded("object-removed")):
        bpy.ops.plgs.make_objects(instances=str(CABINET))
