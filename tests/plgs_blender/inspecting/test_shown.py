"""The lists that a lift's collection carries, where to look from, and what the eyes in the lists hide."""

import json
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest
from blender_helpers import values_of
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from plgs.engine.result_files import MatchedSegment
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.cameras import PATH
from plgs.plgs_blender.inspecting import looks, views
from plgs.plgs_blender.inspecting.highlight import outline_in_space
from plgs.plgs_blender.inspecting.lists import best_view
from plgs.plgs_blender.inspecting.selection import boxes_of, class_row_of, clouds_of, objects_by_key, row_of
from plgs.plgs_blender.inspecting.selection import ids_of as ids
from plgs.plgs_blender.owned import lifts_in
from tiny_lift import CABINET_NAME, CHAIR_NAME
from tiny_scene import CHAIR_ID

from tests.raises_key import raises_key


def test_the_lists_in_blender_match_the_result(root: bpy.types.Collection, lift: Path) -> None:
    told = json.loads((lift / "result" / "instances.json").read_text())["instances"]
    for row, entry in zip(root.plgs.instances, told, strict=True):
        assert (row.instance_id, row.name, row.class_id) == (entry["id"], entry["name"], entry["class_id"])
        assert (row.points, row.views, row.score) == (entry["points"], entry["views"], pytest.approx(entry["score"]))
        assert [round(255 * channel) for channel in row.colour] == entry["colour"]
        assert [mask.frame for mask in row.masks] == [each["frame"] for each in entry["segments"]]
        assert [mask.segment for mask in row.masks] == [each["segment_id"] for each in entry["segments"]]
        first, stored = row.masks[0], entry["segments"][0]
        assert (first.class_name, first.pixels) == (entry["class_name"], stored["pixels"])
        assert first.reason == "75 % agreement"
        assert list(first.rectangle) == pytest.approx(stored["rectangle"])
    points = np.load(lift / "result" / "semantic_points.npz")["class_id"]
    assert {row.class_id: row.points for row in root.plgs.classes} == {
        int(each): int((points == each).sum()) for each in np.unique(points)
    }
    assert {row.name for row in root.plgs.classes if row.is_thing} == {"chair", "cabinet"}
    assert all(row.visible for row in (*root.plgs.instances, *root.plgs.classes))
    assert root.plgs.instance_index == -1


def test_the_lists_are_kept_in_a_saved_file(lift: Path, tmp_path: Path, plgs: ModuleType) -> None:
    assert not hasattr(bpy.types.Collection, "plgs")
    lift_scene.save_lift(lift, tmp_path / "lift.blend")
    assert not hasattr(bpy.types.Collection, "plgs"), "a script that places a lift switches nothing on"
    plgs.register()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "lift.blend"))
        (root,) = lifts_in(bpy.context.scene)
        assert [row.name for row in root.plgs.instances] == [CHAIR_NAME, CABINET_NAME]
        assert all(len(row.masks) for row in root.plgs.instances)
    finally:
        plgs.unregister()


def mask(share: float, *rectangle: float) -> MatchedSegment:
    return MatchedSegment("0001", 1, CHAIR_ID, 0.9, None, 0.5, 100, share, rectangle)  # type: ignore[arg-type]


def test_the_best_view_of_an_object_shows_it_large_and_whole() -> None:
    small, large, cut = mask(0.05, 0.4, 0.4, 0.6, 0.6), mask(0.2, 0.2, 0.2, 0.8, 0.8), mask(0.3, 0.0, 0.2, 0.7, 0.9)
    assert best_view([small, large, cut]) == 1
    assert best_view([small, cut]) == 1, "half of what is cut off is still more"
    assert best_view([]) == best_view([mask(0.0, 0.0, 0.0, 0.0, 0.0)]) == -1


def test_looking_from_a_frame_moves_the_timeline_to_it(root: bpy.types.Collection) -> None:
    scene = bpy.context.scene
    scene.render.resolution_x = 333
    view = next(s for screen in bpy.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D")
    camera = views.look_from_frame(root, "0005", scene, view)
    assert scene.camera == camera and camera["frame"] == "0005"
    assert scene.frame_current == next(m.frame for m in scene.timeline_markers if m.name == "0005")
    assert view.region_3d.view_perspective == "CAMERA"
    assert scene.render.resolution_x == 333, "the size of the user's renders is theirs"
    bpy.data.objects.remove(camera)
    with raises_key("camera-gone 0005"):
        views.look_from_frame(root, "0005", scene)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.2])
def test_framing_an_object_fits_its_box_into_the_view(root: bpy.types.Collection, aspect: float) -> None:
    view = next(s for screen in bpy.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D")
    region = view.region_3d
    region.view_perspective = "PERSP"
    turned = region.view_rotation.copy()
    views.frame_instance(root, 1, view, aspect)
    box = boxes_of(root)[1]
    corners = np.array([box.matrix_world @ Vector(corner) for corner in box.bound_box])
    assert np.allclose(region.view_location, corners.mean(axis=0), atol=1e-6) and region.view_rotation == turned
    radius = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()
    # Blender's view of a lens: 72 mm along the longer side.
    half = 36.0 / view.lens * min(1.0, 1.0 / aspect if aspect > 1.0 else aspect)
    fills = radius / (region.view_distance * half)
    assert 0.4 < fills < 1.0


TWO_POLYGONS = "0.250,0.100 0.750,0.100 0.750,0.600 0.250,0.600;0.000,0.000 1.000,0.000 1.000,1.000"


@pytest.mark.parametrize("outline", ["", TWO_POLYGONS])
def test_an_objects_outline_matches_the_photo(outline: str, root: bpy.types.Collection) -> None:
    camera = objects_by_key(root)["frame:0003"]
    scene = bpy.context.scene
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    bpy.context.view_layer.update()
    rectangle = (0.25, 0.1, 0.75, 0.6)
    polygons = outline_in_space(camera, outline, rectangle)
    seen = [[world_to_camera_view(scene, camera, corner)[:2] for corner in polygon] for polygon in polygons]
    assert np.allclose(seen[0], [(0.25, 0.9), (0.75, 0.9), (0.75, 0.4), (0.25, 0.4)], atol=1e-4)
    assert not outline or np.allclose(seen[1], [(0, 1), (1, 1), (1, 0)], atol=1e-4)


def seen(root: bpy.types.Collection) -> dict[str, int]:
    """How many points each cloud that is shown has left after its modifiers, and which boxes are shown."""
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    for cloud in clouds_of(root):
        opened = cloud.modifiers.get("Open room")
        if opened is not None:
            opened.show_viewport = False
    bpy.context.view_layer.update()
    clouds = {
        ob.name: len(ob.evaluated_get(graph).data.points)
        for ob in clouds_of(root)
        if ob.name != "Anchors" and not ob.hide_get()
    }
    boxes = {ob.name: 0 for ob in boxes_of(root).values() if not ob.hide_get()}
    return {name: count for name, count in clouds.items() if count} | boxes


def stored(lift: Path) -> np.ndarray:
    points = np.load(lift / "result" / "semantic_points.npz")
    return np.stack([points["class_id"], points["instance_id"]])


def test_hiding_an_instance_hides_its_box_points_and_anchors(root: bpy.types.Collection, lift: Path) -> None:
    root.plgs.show_boxes = True
    before, row = seen(root), row_of(root, 1)
    row.visible = False
    after = seen(root)
    assert f"{row.name} box" in before and f"{row.name} box" not in after
    class_id, instance_id = stored(lift)
    left = sum(count for name, count in after.items())
    assert sum(before.values()) - left == (instance_id == 1).sum()
    anchors = next(cloud for cloud in clouds_of(root) if cloud.name == "Anchors")
    hidden = values_of(anchors.data, looks.HIDDEN)
    assert np.array_equal(hidden, np.load(lift / "result" / "anchors.npz")["instance_id"] == 1)
    row.visible = True
    assert seen(root) == before
    assert not any(looks.HIDDEN in cloud.data.attributes for cloud in clouds_of(root))
    assert not any(cloud.modifiers.get(looks.MODIFIER) for cloud in clouds_of(root))


def test_hiding_a_class_hides_its_instances(root: bpy.types.Collection) -> None:
    root.plgs.show_boxes = True
    before = seen(root)
    class_row_of(root, CHAIR_ID).visible = False
    assert set(before) - set(seen(root)) == {"chair points", "chair 1 box"}
    looks.show_all(root)
    assert seen(root) == before and all(row.visible for row in root.plgs.classes)


def test_isolating_an_object_frames_it_without_stray_points(root: bpy.types.Collection) -> None:
    view = next(s for screen in bpy.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D")
    before = view.region_3d.view_location.copy(), view.region_3d.view_distance
    cloud = next(ob for ob in clouds_of(root) if ob.get("class_id") == CHAIR_ID)
    stray = int(np.flatnonzero(ids(cloud.data, "instance_id") == 1)[0])
    cloud.data.points[stray].co = (30.0, 0.0, 0.0)
    looks.isolate(root, 1)
    views.show_alone(root, view, 1.5)
    hidden = values_of(cloud.data, looks.HIDDEN)
    assert hidden[stray] and not hidden.all()
    assert (view.region_3d.view_location - boxes_of(root)[1].matrix_world.translation).length < 1e-3
    looks.isolate(root, 1)
    views.show_alone(root, view, 1.5)
    assert (view.region_3d.view_location, view.region_3d.view_distance) == before


def test_ending_isolation_shows_what_was_shown_before(root: bpy.types.Collection, lift: Path) -> None:
    root.plgs.show_boxes, row_of(root, 2).visible = True, False
    before = seen(root)
    looks.isolate(root, 1)
    alone = seen(root)
    assert set(alone) == {"chair points", "chair 1 box"} and alone["chair points"] == (stored(lift)[1] == 1).sum()
    looks.isolate(root, 2)
    assert set(seen(root)) == {"cabinet points", "cabinet 1 box"}, "alone even though its eye is closed"
    looks.isolate(root, 2)
    assert seen(root) == before and not row_of(root, 2).visible
    looks.isolate(root, 1)
    looks.show_all(root)
    assert root.plgs.isolated == 0 and {"chair 1 box", "cabinet 1 box"} <= set(seen(root))


def test_hidden_objects_stay_hidden_in_a_saved_file(root: bpy.types.Collection, tmp_path: Path) -> None:
    row_of(root, 1).visible = False
    before = seen(root)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    (again,) = [each for each in bpy.data.collections if each.name == "PLGS tiny room"]
    assert seen(again) == before
    assert not again.plgs.instances[0].visible


def test_hidden_cameras_are_drawn_at_blenders_smallest_size(root: bpy.types.Collection) -> None:
    ours = [ob for key, ob in objects_by_key(root).items() if key.startswith(("frame:", PATH)) and ob.type == "CAMERA"]
    smallest = ours[0].data.bl_rna.properties["display_size"].hard_min
    assert len(ours) > 1 and {round(ob.data.display_size, 6) for ob in ours} == {round(smallest, 6)}
    root.plgs.show_cameras = True
    assert min(ob.data.display_size for ob in ours) > 10 * smallest
