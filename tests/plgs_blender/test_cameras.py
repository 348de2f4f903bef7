"""Blender's cameras see what the engine's cameras see, also the one that moves along the frames."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from blender_helpers import look_through
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from plgs.engine.scene import Camera, Frame
from plgs.plgs_blender.cameras import camera_seen, object_matrix, place_camera_path, set_lens
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.owned import OwnedDataBlocks
from tiny_scene import write_tiny_scene

INTRINSICS = {
    "plain": (640, 480, 500.0, 500.0, 320.0, 240.0),
    "off-centre": (640, 480, 577.87, 577.87, 301.3, 262.9),
    "wide pixels": (640, 480, 600.0, 480.0, 330.0, 231.0),
    "tall pixels": (640, 480, 480.0, 600.0, 310.0, 255.0),
    "portrait": (480, 640, 520.0, 520.0, 240.0, 320.0),
    "portrait, all wrong": (480, 853, 610.0, 555.0, 200.0, 500.0),
    "square": (512, 512, 300.0, 310.0, 250.0, 262.0),
    "panorama strip": (2000, 300, 900.0, 900.0, 1100.0, 120.0),
}


def camera(name: str) -> Camera:
    random = np.random.default_rng(len(name))
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = random.uniform(-5.0, 5.0, 3)
    return Camera(*INTRINSICS[name], pose)


def points_before(camera: Camera) -> np.ndarray:
    """World points [20, 3] whose pixels lie in the picture and around it."""
    random = np.random.default_rng(0)
    pixels = random.uniform(-0.2, 1.2, (20, 2)) * (camera.width, camera.height)
    rays = np.concatenate([(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((20, 1))], axis=1)
    return (rays * random.uniform(0.5, 8.0, (20, 1))) @ camera.camera_to_world[:3, :3].T + camera.centre


@pytest.mark.parametrize("name", INTRINSICS)
def test_blender_cameras_project_points_to_the_engines_pixels(name: str) -> None:
    theirs = camera(name)
    scene = bpy.context.scene
    ob = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(ob)
    set_lens(ob.data, theirs)
    ob.matrix_world = Matrix(object_matrix(theirs).tolist())
    for key in ("width", "height", "fx", "fy"):
        ob[key] = getattr(theirs, key)
    look_through(scene, ob)
    bpy.context.view_layer.update()

    points = points_before(theirs)
    pixels, depth = theirs.project(points)
    seen = [world_to_camera_view(scene, ob, Vector(point)) for point in points]
    found = np.array([(at.x * theirs.width, (1.0 - at.y) * theirs.height) for at in seen])
    # Blender keeps lenses in single precision.
    assert np.abs(found - pixels).max() < 1e-3 * max(1.0, np.abs(pixels).max() / 1000.0)
    assert np.allclose([at.z for at in seen], depth, atol=1e-4)


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
@pytest.mark.parametrize("aspect", [(1.0, 1.0), (1.0, 2.5), (1.6, 1.0)])
def test_the_engine_sees_what_a_users_camera_sees(fit: str, size: tuple[int, int], aspect: tuple[float, float]) -> None:
    scene = bpy.context.scene
    scene.camera = ob = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    scene.collection.objects.link(ob)
    ob.data.sensor_fit, ob.data.sensor_width, ob.data.sensor_height = fit, 30.0, 21.0
    ob.data.lens, ob.data.shift_x, ob.data.shift_y = 40.0, 0.13, -0.21
    ob.location, ob.rotation_euler, ob.scale = (1.0, 2.0, 3.0), (0.4, -0.5, 2.6), (2.0, 0.5, 3.0)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 2 * size[0], 2 * size[1], 50
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    bpy.context.view_layer.update()

    seen = camera_seen(scene)
    assert seen is not None and (seen.width, seen.height) == size
    points = points_before(seen)
    theirs = [world_to_camera_view(scene, ob, Vector(point)) for point in points]
    found = np.array([(at.x * size[0], (1.0 - at.y) * size[1]) for at in theirs])
    assert np.abs(found - seen.project(points)[0]).max() < 2e-3


def test_only_perspective_cameras_give_a_live_preview() -> None:
    scene = bpy.context.scene
    scene.camera = None
    assert camera_seen(scene) is None
    scene.camera = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
    assert camera_seen(scene) is None
    scene.camera = bpy.data.objects.new("flat", bpy.data.cameras.new("flat"))
    assert camera_seen(scene) is not None
    scene.camera.data.type = "ORTHO"
    assert camera_seen(scene) is None
    scene.camera.data.type = "PERSP"
    scene.camera.scale.x = -1.0
    scene.collection.objects.link(scene.camera)
    bpy.context.view_layer.update()
    assert camera_seen(scene) is None


def curves(block: bpy.types.ID) -> dict[tuple[str, int], bpy.types.FCurve]:
    """A data-block's animation curves, by path and index."""
    action = block.animation_data.action
    if hasattr(action, "layers"):
        bags = [strip.channelbag(block.animation_data.action_slot) for layer in action.layers for strip in layer.strips]
        return {(curve.data_path, curve.array_index): curve for bag in bags if bag for curve in bag.fcurves}
    return {(curve.data_path, curve.array_index): curve for curve in action.fcurves}


def test_the_camera_path_passes_through_every_frame(tmp_path: Path) -> None:
    scene = bpy.context.scene
    root = place_scene(ChosenScene(write_tiny_scene(tmp_path / "room", frames=7)), scene)
    path = next(ob for ob in root.objects if ob.name == "Camera path")
    markers = {marker.camera: marker.frame for marker in scene.timeline_markers}
    assert len(markers) == 7
    for ob, frame in markers.items():
        scene.frame_set(frame)
        assert np.abs(np.array(path.matrix_world) - np.array(ob.matrix_world)).max() < 1e-5
        for name in ("lens", "shift_x", "shift_y", "sensor_width"):
            assert getattr(path.data, name) == pytest.approx(getattr(ob.data, name), abs=1e-6)


def test_the_camera_path_moves_straight_between_frames(tmp_path: Path) -> None:
    root = place_scene(ChosenScene(write_tiny_scene(tmp_path / "room", frames=4)), bpy.context.scene)
    path = next(ob for ob in root.objects if ob.name == "Camera path")
    kinds = {key: {point.interpolation for point in curve.keyframe_points} for key, curve in curves(path).items()}
    assert set(kinds) == {("location", i) for i in range(3)} | {("rotation_quaternion", i) for i in range(4)}
    assert all(each == {"LINEAR"} for each in kinds.values())
    lens = curves(path.data)
    assert set(lens) == {("lens", 0), ("shift_x", 0), ("shift_y", 0)}
    assert all(point.interpolation == "CONSTANT" for curve in lens.values() for point in curve.keyframe_points)


def test_importing_again_leaves_no_old_keys_of_the_camera_path(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path / "room", frames=6)
    place_scene(ChosenScene(folder), bpy.context.scene)
    for name in ("color", "depth", "pose"):
        for file in (folder / name).glob("000[45].*"):
            file.unlink()
    root = place_scene(ChosenScene(folder), bpy.context.scene)
    path = next(ob for ob in root.objects if ob.name == "Camera path")
    assert all(len(curve.keyframe_points) == 4 for curve in curves(path).values())
    assert sorted(action.name for action in bpy.data.actions) == ["Camera path lens", "Camera path pose"]


def test_the_camera_path_takes_the_shorter_turn() -> None:
    """The quaternions of two cameras that nearly agree may have opposite signs."""
    scene = bpy.context.scene
    owned = OwnedDataBlocks("a lift", scene)
    frames = [frame_turned(angle) for angle in np.radians([150.0, 170.0, 190.0, 210.0])]
    path = place_camera_path(owned, scene.collection, frames, range(1, 1 + len(frames)))
    found = curves(path)
    turns = np.array([[key.co.y for key in found["rotation_quaternion", i].keyframe_points] for i in range(4)]).T
    assert ((turns[1:] * turns[:-1]).sum(axis=1) > 0.9).all()


def frame_turned(angle: float) -> Frame:
    """A frame whose camera is turned about the world's z."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose)
    black = np.zeros((48, 64, 3), np.uint8)
    return Frame(f"{angle:.2f}", camera, False, Path("none.png"), None, lambda size: black, None, None)
