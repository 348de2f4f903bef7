"""The lift's markers are on the timeline while one of its cameras is active, and never take over another."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender import lift_scene, timeline
from plgs.plgs_blender.inspecting.views import look_from_frame


@pytest.fixture
def following() -> Iterator[None]:
    """As while the extension is on."""
    timeline.register()
    yield
    timeline.unregister()


@pytest.mark.usefixtures("following")
def test_a_camera_that_the_user_adds_later_stays_active(lift: Path) -> None:
    scene = bpy.context.scene
    root = lift_scene.place_lift(lift, scene)
    scene.timeline_markers["0002"].frame = 40  # markers may be moved
    before = {marker.name: marker.frame for marker in scene.timeline_markers}
    mine = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    copy = bpy.data.objects["0001"].copy()
    cut = scene.timeline_markers.new("cut", frame=3)
    for camera in (mine, copy, bpy.data.objects["Camera path"]):
        if camera.name not in scene.objects:
            scene.collection.objects.link(camera)
        scene.camera = camera
        for frame in (0, 2, 40):
            scene.frame_set(frame)
            assert scene.camera == camera
        assert scene.timeline_markers[:] == [cut]
    look_from_frame(root, "0002", scene)
    assert scene.frame_current == 40
    scene.timeline_markers.remove(cut)
    assert {marker.name: marker.frame for marker in scene.timeline_markers} == before
    scene.frame_set(1)
    assert scene.camera["frame"] == "0000"


def test_the_users_marker_at_a_copy_of_our_camera_stays(lift: Path) -> None:
    scene = bpy.context.scene
    lift_scene.place_lift(lift, scene)
    copy = bpy.data.objects["0001"].copy()
    scene.collection.objects.link(copy)
    cut = scene.timeline_markers.new("cut", frame=3)
    cut.camera = scene.camera = copy
    timeline.follow_camera(scene)
    assert [(marker.name, marker.camera) for marker in scene.timeline_markers] == [("cut", copy)]
    lift_scene.place_lift(lift, scene)
    assert ("cut", copy) in [(marker.name, marker.camera) for marker in scene.timeline_markers]
