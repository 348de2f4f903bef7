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


@pytest.mark.parametrize(
    ("names", "places"),
    [
        (("0012", "0013", "0040"), [12, 13, 40]),
        (("rgb_7.color", "rgb_8.color"), [7, 8]),
        (("b", "a"), [0, 1]),
        (("9", "8"), [0, 1]),
        (("1305031102175304", "1305031102211214"), [0, 1]),
    ],
)
def test_frames_are_at_their_numbers(names: tuple[str, ...], places: list[int]) -> None:
    scene, root = bpy.context.scene, bpy.data.collections.new("PLGS")
    root["plgs_lift"], root["plgs_key"] = "a lift", "lift"
    scene.collection.children.link(root)
    cameras = []
    for name in (*names, "Overview"):
        camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
        camera["plgs_lift"], camera["plgs_key"] = "a lift", f"frame:{name}"
        if name != "Overview":
            camera["frame"] = name
        root.objects.link(camera)
        cameras.append(camera)
    assert timeline.mark_timeline(scene, root, cameras[-1], cameras[:-1]) == places
    assert timeline.places_of(root, scene) == dict(zip(cameras, [*places, places[-1] + 1], strict=True))


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
    assert scene.camera["frame"] == "0001"


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
