"""What a file shows: a view that holds the room, colours of any OCIO configuration, markers on the timeline."""

import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest
import tiny_lift
from mathutils import Euler
from plgs.plgs_blender import lifecycle, lift_scene, timeline
from plgs.plgs_blender.inspecting.views import look_from_frame
from plgs.plgs_blender.meshes import mesh_folder
from plgs.plgs_blender.viewport import areas_of, frame_room, show_lift_colours
from surface_file import write_surface


def area(width: int, height: int, bar: int) -> Any:
    regions = [
        SimpleNamespace(type="WINDOW", width=width, height=height, x=0),
        SimpleNamespace(type="UI", width=bar, height=height, x=width - bar),
    ]
    space = SimpleNamespace(lens=50.0, region_3d=SimpleNamespace())
    return SimpleNamespace(regions=regions, spaces=SimpleNamespace(active=space))


@pytest.mark.parametrize("size", [(19.0, 11.0, 3.0), (4.0, 4.0, 40.0), (1.0, 30.0, 2.0)])
@pytest.mark.parametrize(("width", "height", "bar"), [(1586, 928, 1), (1057, 840, 291), (500, 900, 200)])
def test_a_framed_room_fits_beside_the_panels(size: tuple[float, ...], width: int, height: int, bar: int) -> None:
    corners = np.array(list(product(*((-2.0, side - 2.0) for side in size))))
    shown = area(width, height, bar)
    rotation = Euler((0.9, 0.0, 1.2)).to_quaternion()
    frame_room(shown, rotation, corners)
    view = shown.spaces.active.region_3d
    local = (corners - np.array(view.view_location)) @ np.array(view.view_rotation.to_matrix())
    seen = local[:, :2] / (view.view_distance - local[:, 2:]) * 50.0 / 36.0 * max(width, height) / 2.0  # in pixels
    covered = bar if bar > 1 else 0
    free = np.array([[-width / 2, -height / 2], [width / 2 - covered, height / 2]])
    assert (seen >= free[0]).all() and (seen <= free[1]).all()
    assert (np.ptp(seen, axis=0) / np.ptp(free, axis=0)).max() > 0.9


CONFIGURATION = """ocio_profile_version: 2
roles: {{default: raw, scene_linear: lin, data: raw, color_picking: disp}}
displays:
  Monitor:
{views}
colorspaces:
  - !<ColorSpace> {{name: raw, isdata: true}}
  - !<ColorSpace> {{name: lin, isdata: false}}
  - !<ColorSpace>
    name: disp
    isdata: false
    from_scene_reference: !<ExponentTransform> {{value: [2.2, 2.2, 2.2, 1], direction: inverse}}
"""
START = """
import tests.conftest
from plgs.plgs_blender.passes import _new_scene
from plgs.plgs_blender.viewport import start_file
print("chosen:", start_file().view_settings.view_transform, _new_scene("x").view_settings.view_transform, sep="|")
"""


@pytest.mark.parametrize(
    ("views", "chosen"),
    [(None, "Standard"), (["ACES 1.0 - SDR Video", "Un-tone-mapped", "Raw"], "Un-tone-mapped"), (["Plain"], "Plain")],
    ids=["Blender's own", "like ACES", "minimal"],
)
def test_view_transforms_fit_any_ocio_config(views: list[str] | None, chosen: str, tmp_path: Path, root: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OCIO"} | {"PYTHONPATH": str(root)}
    if views is not None:
        lines = "\n".join(f'    - !<View> {{name: "{view}", colorspace: disp}}' for view in views)
        (tmp_path / "config.ocio").write_text(CONFIGURATION.format(views=lines))
        environment["OCIO"] = str(tmp_path / "config.ocio")
    done = subprocess.run(
        [sys.executable, "-c", START], cwd=root, env=environment, capture_output=True, text=True, timeout=300
    )
    assert f"chosen:|{chosen}|{chosen}" in done.stdout, done.stdout + done.stderr


@pytest.fixture
def following() -> Iterator[None]:
    """As while the extension is on."""
    lifecycle.register_modules([timeline])
    yield
    lifecycle.unregister_modules([timeline])


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
def test_timeline_markers_lie_at_the_frames_numbers(names: tuple[str, ...], places: list[int]) -> None:
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


def test_solid_shading_shows_textures_of_meshes_and_no_white_objects(extension: None, tmp_path: Path) -> None:
    """Only for what has pictures: splats, points, classes and shadow catchers keep their own colours."""
    lift = tiny_lift.write_tiny_lift(tmp_path / "lift")
    write_surface(mesh_folder(lift.path) / "mesh.ply", shade=40)
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)
    scene = bpy.context.scene
    shadings = [each.spaces.active.shading for each in areas_of(scene)]
    assert shadings
    for each in areas_of(scene):
        show_lift_colours(each.spaces.active)
    lists = lift_scene.place_lift(lift.path, scene).plgs

    def shown() -> set[tuple[str, bool]]:
        return {(each.color_type, each.show_cavity) for each in shadings}

    assert lists.show_as == "SURFACE" and shown() == {("TEXTURE", True)}
    for name, other in (("look", "CLASSES"), ("catch_shadows", True), ("show_as", "POINTS")):
        before = getattr(lists, name)
        setattr(lists, name, other)
        assert shown() == {("VERTEX", False)}, name
        setattr(lists, name, before)
        assert shown() == {("TEXTURE", True)}, name
    scene.view_layers[0].layer_collection.children[-1].exclude = True  # then it is a matter of what else there is
    second = lift_scene.place_lift(tiny_lift.write_tiny_lift(tmp_path / "other" / "lift", instances=1).path, scene)
    assert second.plgs.show_as != "SURFACE" and shown() == {("VERTEX", False)}
    shadings[0].color_type = "OBJECT"  # a user's own choice
    lists.look = "CLASSES"
    assert shadings[0].color_type == "OBJECT"
