"""A lift in Blender: what is there, what stays after saving, and what a second lift leaves alone."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from blender_helpers import DATA, contents, counts, values_of
from plgs.engine.scene import open_scene
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.cameras import object_matrix
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.inspecting.looks import lifts_shown
from plgs.plgs_blender.inspecting.selection import CHOSEN
from plgs.plgs_blender.inspecting.views import look_from_frame
from plgs.plgs_blender.materials import linear_rgba
from plgs.plgs_blender.owned import LIFT
from plgs.plgs_blender.timeline import places_of
from tiny_lift import CABINET_NAME, CHAIR_NAME, FRAMES, mend_manifest, write_tiny_lift
from tiny_scene import CHAIR, CHAIR_ID

from tests.raises_key import raises_key


def child(root: bpy.types.Collection, name: str) -> bpy.types.Collection:
    return next(each for each in root.children if each.name.partition(".")[0] == name)


def test_a_placed_lift_is_one_collection(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    assert root.name == "PLGS tiny room"
    assert [each.name for each in root.children] == ["Cameras", "Semantic points", "Anchors", "Instances"]
    assert [ob.name for ob in child(root, "Cameras").objects] == [f"{k:04d}" for k in range(FRAMES)]
    assert [ob.name for ob in child(root, "Instances").objects] == [f"{CHAIR_NAME} box", f"{CABINET_NAME} box"]
    assert {ob.name for ob in child(root, "Semantic points").objects} >= {"wall points", "floor points", "chair points"}
    assert [ob.type for ob in child(root, "Anchors").objects] == ["POINTCLOUD"]
    assert lift_scene.lifts_in(bpy.context.scene) == [root]


def test_cameras_stand_where_the_frames_were_taken(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    bpy.context.view_layer.update()
    scene = open_scene(lift.parent / "tiny room")
    for ob, frame in zip(child(root, "Cameras").objects, scene.frames, strict=True):
        assert np.allclose(ob.matrix_world, object_matrix(frame.camera), atol=1e-6)
        assert (ob["frame"], ob["held_out"]) == (frame.name, frame.held_out)
        assert (ob["width"], ob["height"], ob["fx"], ob["cy"]) == (64, 48, frame.camera.fx, frame.camera.cy)
        picture = ob.data.background_images[0].image
        assert not ob.data.show_background_images, "until it is asked for"
        assert Path(bpy.path.abspath(picture.filepath)) == frame.colour_path


def test_points_keep_their_attributes_through_a_file(lift: Path, tmp_path: Path) -> None:
    blend = tmp_path / "lift.blend"
    lift_scene.save_lift(lift, blend)
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    stored = np.load(lift / "result" / "semantic_points.npz")
    chair = bpy.data.objects["chair points"]
    mine = stored["class_id"] == CHAIR_ID
    assert np.array_equal(values_of(chair.data, "position", "vector", 3), stored["xyz"][mine])
    assert np.array_equal(values_of(chair.data, "class_id"), stored["class_id"][mine])
    assert np.array_equal(values_of(chair.data, "instance_id"), stored["instance_id"][mine])
    assert np.array_equal(values_of(chair.data, "confidence"), stored["confidence"][mine])
    assert np.allclose(values_of(chair.data, "Col", "color", 4), linear_rgba(stored["rgb"][mine]), atol=1e-6)
    assert np.allclose(chair.color, linear_rgba([210, 70, 60]), atol=1e-6)
    clouds = [ob for ob in bpy.data.objects if ob.type == "POINTCLOUD" and ob.name != "Anchors"]
    assert sum(len(ob.data.points) for ob in clouds) == len(stored["xyz"])

    stored = np.load(lift / "result" / "anchors.npz")
    anchors = bpy.data.objects["Anchors"]
    for name in ("class_id", "instance_id", "level", "opacity"):
        assert np.array_equal(values_of(anchors.data, name), stored[name])
    assert not anchors.visible_get()
    assert anchors.hide_render or anchors.users_collection[0].hide_render


def test_boxes_have_the_properties_of_their_objects(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    bpy.context.view_layer.update()
    box = next(ob for ob in child(root, "Instances").objects if ob["instance_id"] == 1)
    assert (box["class"], box["class_id"], box["views"], box["score"]) == ("chair", CHAIR_ID, 7, 0.875)
    assert box["points"] == 1234
    assert np.allclose(box["size"], CHAIR[1] - CHAIR[0])
    corners = np.array([box.matrix_world @ vertex.co for vertex in box.data.vertices])
    assert np.allclose([corners.min(axis=0), corners.max(axis=0)], CHAIR, atol=1e-6)
    assert np.allclose(box.color, linear_rgba([250, 180, 20]), atol=1e-6)
    assert box.display_type == "WIRE"


def test_a_box_has_the_rotation_of_the_instance(tmp_path: Path) -> None:
    lift = write_tiny_lift(tmp_path / "lift", frames=4, instances=1, bake=False).path
    path = lift / "result" / "instances.json"
    content = json.loads(path.read_text())
    content["instances"][0].update(yaw=np.pi / 6, rotation=[np.cos(np.pi / 12), 0.0, 0.0, np.sin(np.pi / 12)])
    path.write_text(json.dumps(content))
    mend_manifest(lift)
    root = lift_scene.place_lift(lift, bpy.context.scene)
    bpy.context.view_layer.update()
    assert child(root, "Instances").objects[0].matrix_world.to_euler().z == pytest.approx(np.pi / 6)


def test_placing_a_lift_again_replaces_it(lift: Path, tmp_path: Path) -> None:
    blend = tmp_path / "lift.blend"
    lift_scene.save_lift(lift, blend)
    first, first_count = contents(), counts()
    lift_scene.save_lift(lift, blend)
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert counts() == first_count
    for kind in ("objects", "collections", "cameras", "meshes", "materials", "scenes"):
        assert contents()[kind] == first[kind]
    orphans = [b.name for kind in DATA for b in getattr(bpy.data, kind) if LIFT in b and not b.users]
    assert orphans == []


def test_two_lifts_of_one_scene_have_separate_collections(lift: Path, tmp_path: Path) -> None:
    scene = bpy.context.scene
    first = lift_scene.place_lift(lift, scene)
    camera = bpy.data.objects["0003"]
    other = write_tiny_lift(tmp_path / "other", scene=lift.parent / "tiny room", instances=1, bake=False).path
    second = lift_scene.place_lift(other, scene)
    assert lift_scene.lifts_in(scene) == [first, second]
    assert [len(child(root, "Instances").objects) for root in (first, second)] == [2, 1]
    assert (first.name, second.name) == ("PLGS tiny room", "PLGS other")
    assert bpy.data.objects["0003"] == camera and places_of(second, scene).keys().isdisjoint(places_of(first, scene))
    # The later one is shown, and what it hides can be shown again.
    assert scene[CHOSEN] == second[LIFT] and lifts_shown(scene, bpy.context.view_layer) == [second]
    assert first.hide_render and not second.hide_render
    before = counts()
    for again in (lift, other):
        lift_scene.place_lift(again, scene)
    assert lift_scene.lifts_in(scene) == [first, second] and counts() == before
    assert lifts_shown(scene, bpy.context.view_layer) == [second]


def test_a_renamed_lift_is_found_again(lift: Path) -> None:
    root = lift_scene.place_lift(lift, bpy.context.scene)
    before = counts()
    root.name = "My room"
    for ob in list(bpy.data.objects):
        ob.name = "renamed"
    assert lift_scene.place_lift(lift, bpy.context.scene) == root
    assert counts() == before
    assert "0000" in bpy.data.objects and "renamed" not in bpy.data.objects


def test_placing_a_lift_keeps_the_users_objects(lift: Path) -> None:
    scene = bpy.context.scene
    root = lift_scene.place_lift(lift, scene)
    mine = bpy.data.objects.new("mine", bpy.data.meshes.new("mine"))
    child(root, "Instances").objects.link(mine)
    copy = bpy.data.objects[f"{CHAIR_NAME} box"].copy()
    copy.location.x += 5.0
    scene.collection.objects.link(copy)
    scene.timeline_markers.new("cut", frame=3)
    scene.render.resolution_x = 333
    before = (copy.location.x, scene.frame_end, scene.render.engine)
    other_instances = bpy.data.objects[f"{CABINET_NAME} box"]
    lift_scene.place_lift(lift, scene)
    assert mine.name == "mine" and mine.users_collection == (child(root, "Instances"),)
    assert (copy.location.x, scene.frame_end, scene.render.engine) == before
    assert LIFT not in copy and LIFT in other_instances
    assert [m.frame for m in scene.timeline_markers if m.name == "cut"] == [3]
    assert scene.render.resolution_x == 333
    lift_scene.place_lift(lift, scene)
    assert copy.name in bpy.data.objects and copy.data is not None


def test_placing_a_lift_keeps_the_users_active_camera(lift: Path) -> None:
    scene = bpy.context.scene
    mine = bpy.data.objects.new("shot", bpy.data.cameras.new("shot"))
    scene.collection.objects.link(mine)
    scene.camera = mine
    for _ in range(2):
        root = lift_scene.place_lift(lift, scene)
        for frame in (1, 100, scene.frame_end, scene.frame_end + 2):
            scene.frame_set(frame)
            assert scene.camera == mine
        assert not scene.timeline_markers
    scene.frame_set(5)
    view = SimpleNamespace(use_local_camera=False, camera=None, region_3d=SimpleNamespace(view_perspective="PERSP"))
    look_from_frame(root, "0000", scene, view)
    assert (scene.camera, scene.frame_current) == (mine, 5), "only the view turns"
    assert view.use_local_camera and view.camera["frame"] == "0000" and not scene.timeline_markers
    scene.camera = bpy.data.objects["0003"]
    look_from_frame(root, "0001", scene, view)
    assert scene.camera["frame"] == "0001" and not view.use_local_camera
    assert scene.frame_current == scene.frame_end + 2
    assert len(scene.timeline_markers) == FRAMES + 1


def test_a_saved_file_finds_its_lift_after_both_moved(lift: Path, tmp_path: Path) -> None:
    shutil.copytree(lift.parent, tmp_path / "a")
    request = tmp_path / "a" / "lift" / "request.json"
    request.write_text(request.read_text().replace(str(lift.parent), str(tmp_path / "a")))
    for blend in (tmp_path / "a" / "lift" / "lift.blend", tmp_path / "mine.blend"):
        for _ in range(2):
            lift_scene.save_lift(tmp_path / "a" / "lift", blend)
    assert [path.name for path in tmp_path.rglob("*.blend1")] == ["mine.blend1"], "only of files beside lifts"
    (tmp_path / "a").rename(tmp_path / "b")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "lift" / "lift.blend"))
    files = [image.filepath for image in bpy.data.images if LIFT in image and image.filepath]
    assert files and all(path.startswith("//") for path in files)
    assert all(Path(bpy.path.abspath(path)).is_file() for path in files)


def test_placing_an_unfinished_lift_changes_nothing(lift: Path, tmp_path: Path) -> None:
    shutil.copytree(lift, tmp_path / "half")
    (tmp_path / "half" / "result" / "manifest.json").unlink()
    before = contents()
    with raises_key("not-finished"):
        lift_scene.place_lift(tmp_path / "half", bpy.context.scene)
    with raises_key("not-finished"):
        lift_scene.save_lift(tmp_path / "half", tmp_path / "x.blend")
    assert contents() == before and not (tmp_path / "x.blend").exists()


def test_objects_deleted_from_a_lift_return_when_it_is_placed_again(lift: Path) -> None:
    scene = bpy.context.scene
    root = lift_scene.place_lift(lift, scene)
    bpy.data.collections.remove(child(root, "Instances"))
    child(root, "Cameras").objects.unlink(bpy.data.objects["0003"])
    moved = bpy.data.objects["0004"]
    child(root, "Cameras").objects.unlink(moved)
    scene.collection.objects.link(moved)
    lift_scene.place_lift(lift, scene)
    assert [ob.name for ob in child(root, "Instances").objects] == [f"{CHAIR_NAME} box", f"{CABINET_NAME} box"]
    assert "0003" in child(root, "Cameras").objects
    assert moved.users_collection == (scene.collection,)


@pytest.mark.parametrize("copies_mesh", [True, False])
def test_a_users_duplicate_of_a_box_is_never_taken_for_the_original(lift: Path, copies_mesh: bool) -> None:
    scene = bpy.context.scene
    root = lift_scene.place_lift(lift, scene)
    box = bpy.data.objects[f"{CHAIR_NAME} box"]
    copy = box.copy()
    if copies_mesh:
        copy.data = box.data.copy()
        box.name, copy.name = "zebra", "aardvark"  # names are the user's
    child(root, "Instances").objects.link(copy)
    for _ in range(2):
        lift_scene.place_lift(lift, scene)
        assert box.name == ("zebra" if copies_mesh else f"{CHAIR_NAME} box") and LIFT in box and LIFT not in copy


def test_a_lift_is_not_placed_into_the_scene_of_its_passes(lift: Path, tmp_path: Path) -> None:
    scene = bpy.context.scene
    root = lift_scene.place_lift(lift, scene)
    passes = bpy.data.scenes["PLGS tiny room passes"]
    before = counts()
    assert lift_scene.place_lift(lift, passes) == root and counts() == before
    assert place_scene(ChosenScene(lift.parent / "tiny room"), passes) == root
    assert not lift_scene.lifts_in(passes) and not passes.objects
    bpy.data.collections.remove(root)
    with raises_key("scene-of-passes"):
        lift_scene.place_lift(lift, passes)


def test_an_override_of_a_linked_lift_is_skipped(lift: Path, tmp_path: Path) -> None:
    lift_scene.save_lift(lift, tmp_path / "lift.blend")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "lift.blend"), link=True) as (there, here):
        here.collections = [name for name in there.collections if name.startswith("PLGS")]
    scene = bpy.context.scene
    scene.collection.children.link(here.collections[0])
    override = here.collections[0].override_hierarchy_create(scene, bpy.context.view_layer)
    root = lift_scene.place_lift(lift, scene)
    assert root.override_library is None and root != override and root.library is None
    assert sorted(ob["instance_id"] for ob in root.all_objects if "instance_id" in ob) == [1, 2]
