"""The moving camera, and how Blender renders what it sees."""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import cv2
import numpy as np
from numpy.typing import NDArray

CAMERA, SHOT_SIZE, SHOT_FRAMES, SHOT_FRAME = "dolly", (960, 540), (1, 25), 9
"""The moving camera, its picture, its first and last frame, and the frame that most pictures show."""
WAY = ("0006", "0010")
"""The camera goes from where this frame was taken to where that one was, which is between the training's frames."""


def write_camera(lift: Path) -> None:
    """The lift's .blend with the moving camera, as LIFT/shot.blend."""
    scene = open_lift(lift)
    ends = [bpy.data.objects[name].matrix_world.copy() for name in WAY]
    data = bpy.data.cameras.new(CAMERA)
    data.lens = 24.0
    camera = bpy.data.objects.new(CAMERA, data)
    camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(camera)
    for frame, end in zip(SHOT_FRAMES, ends, strict=True):
        camera.location, camera.rotation_quaternion = end.translation, end.to_quaternion()
        for path in ("location", "rotation_quaternion"):
            camera.keyframe_insert(path, frame=frame)
    scene.timeline_markers.clear()  # they would change the camera
    scene.camera, (scene.frame_start, scene.frame_end) = camera, SHOT_FRAMES
    scene.render.resolution_x, scene.render.resolution_y = SHOT_SIZE
    scene.render.resolution_percentage = 100
    bpy.ops.wm.save_as_mainfile(filepath=str(lift / "shot.blend"), compress=True, copy=True)


def open_lift(lift: Path, name: str = "lift.blend") -> bpy.types.Scene:
    """The scene of a .blend of the lift's that the frames' cameras are in."""
    bpy.ops.wm.open_mainfile(filepath=str(lift / name))
    return next(scene for scene in bpy.data.scenes if WAY[0] in scene.objects)


def rendered(scene: bpy.types.Scene) -> NDArray[np.uint8]:
    """The scene's picture, uint8 [H, W, 4], colours not multiplied by alpha. RuntimeError when there is none."""
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "8"
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "picture.png")
        with bpy.context.temp_override(scene=scene):
            bpy.ops.render.render(write_still=True)
        picture = cv2.imread(scene.render.filepath, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise RuntimeError(f"Blender rendered nothing of {scene.name}")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA), np.uint8)
