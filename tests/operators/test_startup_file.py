"""In an untouched startup file the view becomes the capture's; what somebody has set or made there stays."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from plgs.engine.known_scene import MadeFrames, StoredScene
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import add_made


@pytest.fixture(autouse=True)
def startup_file(extension: None) -> None:
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)


def size_of(scene: bpy.types.Scene) -> tuple[int, int, float]:
    render = scene.render
    return render.resolution_x, render.resolution_y, render.pixel_aspect_y / render.pixel_aspect_x


def import_room(room: Path) -> bpy.types.Scene:
    assert bpy.ops.plgs.import_scene(scene_folder=str(room), cloud=False) == {"FINISHED"}
    return bpy.context.scene


def test_an_import_removes_the_default_cube_of_an_untouched_startup_file(room: Path) -> None:
    scene = import_room(room)
    assert (scene.frame_start, scene.frame_end) == (0, 7)
    assert scene.camera["frame"] == "0000"
    fx, fy = scene.camera["fx"], scene.camera["fy"]
    assert size_of(scene) == (64, 48, pytest.approx(fx / fy))
    assert not any(bpy.data.objects[name].visible_get() for name in ("Cube", "Light", "Camera"))
    assert bpy.context.view_layer.objects.active is None, "no editor speaks of what is hidden"
    assert bpy.data.objects["Cube"].hide_render and scene.view_settings.view_transform == "Standard"
    for frame in range(8):
        scene.frame_set(frame)
        assert scene.camera["frame"] == f"{frame:04d}"
    assert bpy.ops.plgs.show_picture.poll()


def views_3d() -> list[bpy.types.RegionView3D]:
    areas = [area for window in bpy.context.window_manager.windows for area in window.screen.areas]
    return [area.spaces.active.region_3d for area in areas if area.type == "VIEW_3D"]


def test_after_an_import_the_views_look_at_the_room(room: Path) -> None:
    views = views_3d()
    assert views
    scene = import_room(room)
    eyes = [ob.matrix_world.translation for ob in scene.objects if "frame" in ob]
    for view in views:
        assert view.view_perspective == "PERSP"
        assert min((eye - view.view_location).length for eye in eyes) < view.view_distance


def test_undo_reverts_an_import_in_one_step(room: Path) -> None:
    bpy.ops.ed.undo_push(message="before")
    looks = [repr(view.view_rotation) + view.id_data.name for view in views_3d()], shading()
    import_room(room)
    assert ([repr(view.view_rotation) + view.id_data.name for view in views_3d()], shading()) != looks
    bpy.ops.ed.undo_push(message="import")  # a script's calls push no steps
    bpy.ops.ed.undo()
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end) == (1, 250) and size_of(scene) == (1920, 1080, 1.0)
    assert scene.camera.name == "Camera" and bpy.data.objects["Cube"].visible_get()
    assert not scene.timeline_markers
    assert ([repr(view.view_rotation) + view.id_data.name for view in views_3d()], shading()) == looks


def shading() -> list[tuple[object, ...]]:
    areas = [area for window in bpy.context.window_manager.windows for area in window.screen.areas]
    spaces = [area.spaces.active for area in areas if area.type == "VIEW_3D"]
    return [
        (space.shading.type, space.shading.color_type, space.clip_start, space.overlay.show_floor) for space in spaces
    ]


@pytest.mark.parametrize(
    "touch",
    [
        "scene.frame_end = 100",
        "scene.render.resolution_percentage = 50",
        "scene.timeline_markers.new('cut', frame=3)",
        "bpy.data.objects['Cube'].location.x = 1.0",
        "bpy.data.objects['Cube'].data.vertices[0].co.x = 2.0",
        "bpy.data.objects['Camera'].location.z = 2.0",
        "scene.collection.objects.link(bpy.data.objects.new('mine', None))",
    ],
)
def test_an_import_keeps_the_settings_of_a_changed_startup_file(room: Path, touch: str) -> None:
    scene = bpy.context.scene
    exec(touch, {"bpy": bpy, "scene": scene})
    before = (scene.frame_start, scene.frame_end, size_of(scene), scene.camera)
    import_room(room)
    assert (scene.frame_start, scene.frame_end, size_of(scene), scene.camera) == before
    assert bpy.data.objects["Cube"].visible_get()
    for frame in (scene.frame_start, scene.frame_end):
        scene.frame_set(frame)
        assert scene.camera.name == "Camera"


def test_a_placed_lift_has_its_overview_camera_after_the_last_frame(lift: Path) -> None:
    assert bpy.ops.plgs.place_lift(lift_folder=str(lift)) == {"FINISHED"}
    scene = bpy.context.scene
    last = max(marker.frame for marker in scene.timeline_markers)
    assert (scene.frame_start, scene.frame_end, scene.frame_current) == (0, last - 1, last)
    assert "frame" not in scene.camera and scene.camera.name == "Overview"
    first = min(scene.timeline_markers, key=lambda marker: marker.frame if "frame" in marker.camera else last).camera
    assert size_of(scene)[:2] == (first["width"], first["height"])
    assert not bpy.data.objects["Cube"].visible_get()


def test_placing_a_lift_sets_the_frame_range_of_an_imported_scene(lift: Path, room: Path) -> None:
    scene = import_room(room)
    scene.frame_set(3)
    shown = scene.camera
    assert bpy.ops.plgs.place_lift(lift_folder=str(lift)) == {"FINISHED"}
    assert scene.camera == shown
    last = max(marker.frame for marker in scene.timeline_markers)
    assert (scene.frame_start, scene.frame_end) == (0, last - 1)


def test_photos_cover_a_placed_lift_only_on_request(lift: Path) -> None:
    assert bpy.ops.plgs.place_lift(lift_folder=str(lift)) == {"FINISHED"}
    cameras = [ob for ob in bpy.context.scene.objects if "frame" in ob]
    assert cameras and not any(ob.data.show_background_images for ob in cameras)
    bpy.context.scene.camera = cameras[0]
    assert bpy.ops.plgs.show_picture(what="PHOTO") == {"FINISHED"}
    data = cameras[0].data
    assert data.show_background_images and data.background_images[0].alpha == 1.0


def test_unmoved_views_turn_to_a_point_cloud_that_arrives_later(room: Path, tmp_path: Path) -> None:
    scene = import_room(room)
    view = views_3d()[0]
    before = view.view_distance, view.view_location.copy()
    root = bpy.data.collections["PLGS tiny room"]
    made = MadeFrames(tmp_path, ChosenScene(room).resolved, StoredScene(()), {}, tmp_path / "cloud.npz")
    for size in (30.0, 60.0):
        xyz = np.random.default_rng(0).uniform(-size, size, (2000, 3)).astype(np.float32)
        np.savez(tmp_path / "cloud.npz", xyz=xyz, rgb=np.full(xyz.shape, 200, np.uint8))
        add_made(scene, root, made)
        assert view.view_distance > max(before[0], size)
        before = view.view_distance, view.view_location.copy()
    view.view_location.x += 1.0
    add_made(scene, root, made)
    assert (view.view_distance, view.view_location.x) == (before[0], pytest.approx(before[1].x + 1.0))
