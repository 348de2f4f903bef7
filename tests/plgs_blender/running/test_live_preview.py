"""The growing model before the scene's camera: asked for, shown, and taken away without a trace."""

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest
from blender_helpers import look_through
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Vector
from plgs.engine.job import LiftFolder
from plgs.engine.job.cameras import PreviewCamera, read_preview_request
from plgs.engine.scene import Camera, open_scene
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.running import lifts
from plgs.plgs_blender.viewport import areas_of


@pytest.fixture
def growing(plgs: ModuleType, lift: Path, tmp_path: Path) -> Iterator[LiftFolder]:
    """A lift that the panel is set to, whose scene is imported and seen through its first frame's camera."""
    plgs.register()
    folder = LiftFolder.create(tmp_path / "lift", LiftFolder.open(lift).request)
    scene = bpy.context.scene
    scene.plgs.lift_folder = str(folder.path)
    place_scene(ChosenScene(folder.request.scene), scene)
    for area in areas_of(scene):
        area.spaces.active.region_3d.view_perspective = "CAMERA"
    yield folder
    plgs.unregister()


def picture(folder: LiftFolder) -> Path:
    image = bpy.data.images.new("picture", 8, 6)
    image.pixels = (1.0, 0.5, 0.25, 1.0) * 8 + (0.0, 0.0, 0.0, 1.0) * 40
    folder.live_preview_path.parent.mkdir(parents=True)
    image.filepath_raw, image.file_format = str(folder.live_preview_path), "PNG"
    image.save()
    bpy.data.images.remove(image)
    return folder.live_preview_path


def seen_by_the_engine(folder: LiftFolder) -> Camera:
    asked = read_preview_request(folder.preview_request_path)
    assert isinstance(asked, PreviewCamera)
    lens = asked.K
    return Camera(
        asked.width, asked.height, lens[0][0], lens[1][1], lens[0][2], lens[1][2], np.array(asked.camera_to_world)
    )


def test_the_live_preview_is_requested_once_for_each_camera(growing: LiftFolder) -> None:
    scene = bpy.context.scene
    frame = next(each for each in open_scene(growing.request.scene).frames if each.name == scene.camera["frame"])
    look_through(scene, scene.camera)
    bpy.context.view_layer.update()
    lifts.follow_camera(growing, bpy.data.scenes)
    asked = seen_by_the_engine(growing)
    assert np.allclose(asked.camera_to_world, frame.camera.camera_to_world, atol=1e-5)
    assert np.allclose(asked.K, frame.camera.K, rtol=1e-5)
    growing.preview_request_path.unlink()
    lifts.follow_camera(growing, bpy.data.scenes)
    assert not growing.preview_request_path.exists()


def test_the_live_preview_follows_a_view_that_uses_no_camera(growing: LiftFolder) -> None:
    (area,) = areas_of(bpy.context.scene)
    view, window = area.spaces.active.region_3d, next(each for each in area.regions if each.type == "WINDOW")
    view.view_perspective = "PERSP"
    lifts.follow_camera(growing, bpy.data.scenes)
    asked, place = seen_by_the_engine(growing), Vector((0.5, 1.0, 0.7))
    x, y = asked.project(np.array([place]))[0][0]
    seen = location_3d_to_region_2d(window, view, place)
    share = asked.width / window.width
    assert np.allclose((x / share, window.height - y / share), seen, atol=1.5)
    before = fingerprint(growing)
    assert shown(growing) and lifts.picture_for(bpy.context.scene) is not None
    view.view_location.x += 1.0
    assert lifts.picture_for(bpy.context.scene) is None and shown(growing) and fingerprint(growing) != before


def shown(growing: LiftFolder) -> bool:
    """Ask for the picture of the scene's camera, and show it."""
    lifts.follow_camera(growing, bpy.data.scenes)
    path = growing.live_preview_path if growing.live_preview_path.exists() else picture(growing)
    return lifts.show(growing, path, fingerprint(growing))


def fingerprint(growing: LiftFolder) -> str:
    asked = read_preview_request(growing.preview_request_path)
    assert isinstance(asked, PreviewCamera)
    return asked.fingerprint


def test_the_live_preview_is_shown_and_leaves_no_image_in_the_file(growing: LiftFolder) -> None:
    scene, before = bpy.context.scene, set(bpy.data.images)
    assert lifts.picture_for(scene) is None
    assert shown(growing) and shown(growing)
    pixels = lifts.picture_for(scene)
    assert pixels is not None and pixels.shape == (6, 8, 4) and set(bpy.data.images) - before == set()
    assert np.allclose(pixels[0, 0], (1.0, 0.5, 0.25, 1.0), atol=1e-2)  # as in the file, the lowest row first
    at = scene.camera.location.copy()
    scene.camera.location.x += 1.0
    bpy.context.view_layer.update()
    assert lifts.picture_for(scene) is None
    scene.camera.location = at
    bpy.context.view_layer.update()
    assert lifts.picture_for(scene) is pixels
    scene.plgs.live_preview = False
    assert lifts.picture_for(scene) is None
    scene.plgs.live_preview = True
    lifts.forget(growing.path)
    assert lifts.picture_for(scene) is None


def test_a_live_preview_of_another_camera_is_requested_again(growing: LiftFolder) -> None:
    scene = bpy.context.scene
    lifts.follow_camera(growing, bpy.data.scenes)
    own = fingerprint(growing)
    growing.preview_request_path.unlink()  # as another Blender does that asks for its own
    assert not lifts.show(growing, picture(growing), "of another")
    assert lifts.picture_for(scene) is None
    lifts.follow_camera(growing, bpy.data.scenes)
    assert fingerprint(growing) == own


def test_the_users_camera_shows_the_live_preview_unchanged(growing: LiftFolder) -> None:
    scene = bpy.context.scene
    scene.camera = mine = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    scene.collection.objects.link(mine)
    mine.location = (1.0, 2.0, 3.0)
    bpy.context.view_layer.update()
    assert shown(growing) and lifts.picture_for(scene) is not None
    assert seen_by_the_engine(growing).camera_to_world[:3, 3].tolist() == [1.0, 2.0, 3.0]
    assert not mine.data.background_images and not mine.data.show_background_images
