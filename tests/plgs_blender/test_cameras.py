"""Blender's cameras see what the engine's cameras see."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from frame_size import look_through
from mathutils import Matrix, Vector
from plgs.engine.scene import Camera
from plgs.plgs_blender.cameras import camera_seen, object_matrix, set_lens

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
def test_a_point_falls_on_the_same_pixel(name: str) -> None:
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
def test_what_any_of_the_users_cameras_sees(fit: str, size: tuple[int, int], aspect: tuple[float, float]) -> None:
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


def test_nothing_is_seen_without_a_plain_perspective_camera() -> None:
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
