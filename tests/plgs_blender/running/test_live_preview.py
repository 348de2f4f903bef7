"""The growing model before a camera of ours: asked for, shown, and taken away without a trace."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import pytest
from plgs.engine.job import LiftFolder
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.running import live_preview


@pytest.fixture
def growing(plgs: ModuleType, lift: Path, tmp_path: Path) -> Iterator[LiftFolder]:
    """A lift that the panel is set to, whose scene is imported and seen from its first frame."""
    plgs.register()
    folder = LiftFolder.create(tmp_path / "lift", LiftFolder.open(lift).request)
    scene = bpy.context.scene
    scene.plgs.lift_folder = str(folder.path)
    place_scene(folder.request.scene, scene)
    yield folder
    plgs.unregister()


def picture(folder: LiftFolder) -> Path:
    image = bpy.data.images.new("picture", 8, 6)
    folder.live_preview_path.parent.mkdir(parents=True)
    image.filepath_raw, image.file_format = str(folder.live_preview_path), "PNG"
    image.save()
    bpy.data.images.remove(image)
    return folder.live_preview_path


def backgrounds() -> list[tuple[str, bool, float]]:
    data = bpy.context.scene.camera.data
    return [(each.image.name, each.show_background_image, each.alpha) for each in data.background_images]


def test_the_active_camera_is_asked_for_once(growing: LiftFolder) -> None:
    live_preview.follow_camera(growing, bpy.data.scenes)
    asked = json.loads(growing.preview_request_path.read_text())
    assert asked == {"frame": bpy.context.scene.camera["frame"]}
    growing.preview_request_path.unlink()
    live_preview.follow_camera(growing, bpy.data.scenes)
    assert not growing.preview_request_path.exists()


def test_the_preview_lies_over_the_photo_and_goes_again(growing: LiftFolder) -> None:
    bpy.context.scene.camera.data.background_images[0].alpha = 0.3  # the user's own choice
    before, images = backgrounds(), set(bpy.data.images)
    for _ in range(2):
        live_preview.show(growing, picture(growing) if not growing.live_preview_path.exists()
                          else growing.live_preview_path, bpy.data.scenes)  # fmt: skip
    (shown,) = set(bpy.data.images) - images
    assert len(backgrounds()) == 2 and backgrounds()[:1] == before and tuple(shown.size) == (8, 6)
    live_preview.remove(growing.path)
    assert backgrounds() == before and set(bpy.data.images) == images


def test_what_a_saved_file_kept_of_a_preview_is_taken_away(growing: LiftFolder) -> None:
    before = backgrounds()
    live_preview.show(growing, picture(growing), bpy.data.scenes)
    live_preview.remove_left_over()
    assert backgrounds() == before


def test_a_camera_of_the_users_is_left_alone(growing: LiftFolder) -> None:
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    live_preview.follow_camera(growing, bpy.data.scenes)
    live_preview.show(growing, picture(growing), bpy.data.scenes)
    assert not growing.preview_request_path.exists() and not scene.camera.data.background_images
