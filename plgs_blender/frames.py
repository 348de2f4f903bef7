"""A scene's frames as camera objects with their photos in front of the view, and as one moving camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..engine.posed import Camera
from ..engine.posed.frames import PosedFrame
from .cameras import SENSOR_WIDTH, Lens, camera_from, lens_of, object_matrix
from .compat import add_keys
from .owned import OwnedDataBlocks

SHOWN, PHOTO = "plgs_shown", "PHOTO"
"""Property of a frame's camera that says what is in front of its view, and its value for the photo."""
PATH = "camera_path"
"""Key of the moving camera in its lift."""

_DISPLAY_SIZE = 0.15
"""Metres. Cameras of this size stay readable between furniture."""
_PHOTO_ALPHA = 0.5


def place_camera(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    camera: Camera,
    display_size: float = _DISPLAY_SIZE,
) -> bpy.types.Object:
    """Our camera object `key` with the lens and the pose of the engine's camera, in `parent` when it is new."""
    data = owned.data(key, lambda: bpy.data.cameras.new(name))
    set_lens(data, camera)
    data.display_size = display_size
    ob = owned.object(key, name, data, parent)
    ob.matrix_world = Matrix(object_matrix(camera).tolist())
    return ob


def set_lens(data: bpy.types.Camera, camera: Camera) -> None:
    """Give a Blender camera the engine camera's intrinsics. Sizes of pictures and pixels belong to the scene, and so to
    the user.
    """
    lens = lens_of(camera)
    data.type, data.lens_unit, data.sensor_fit = "PERSP", "MILLIMETERS", "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.lens, data.shift_x, data.shift_y = lens.focal_length, lens.shift_x, lens.shift_y
    data.clip_start, data.clip_end = 0.01, 1000.0


def place_frames(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    frames: Sequence[PosedFrame],
    made: Mapping[str, Path] | None = None,
) -> list[bpy.types.Object]:
    """One camera per frame in `parent`, with the frame's photo in front of its view and what is known as properties.
    `made`: pictures by frame name that an engine made for frames without an image file.
    """
    cameras = []
    for frame in frames:
        ob = place_camera(owned, parent, f"frame:{frame.name}", frame.name, frame.camera)
        ob["frame"], ob["held_out"] = frame.name, bool(frame.held_out)
        for name, kind in (("width", int), ("height", int), ("fx", float), ("fy", float), ("cx", float), ("cy", float)):
            ob[name] = kind(getattr(frame.camera, name))
        picture = picture_of(frame, made)
        if picture is not None:
            show_photo(ob, owned, picture)
        cameras.append(ob)
    return cameras


def camera_seen(scene: bpy.types.Scene) -> Camera | None:
    """What the scene's active camera sees, whoever made it, in a picture of the scene's size. None without an active
    camera in perspective, and for a camera that shows the world mirrored.
    """
    ob = scene.camera
    if ob is None or ob.type != "CAMERA" or ob.data.type != "PERSP" or ob.matrix_world.is_negative:
        return None
    return seen_by(ob, scene.render)


def seen_by(ob: bpy.types.Object, render: bpy.types.RenderSettings) -> Camera:
    """What a camera in perspective sees, in a picture of the render's size."""
    width, height = (
        max(1, side * render.resolution_percentage // 100) for side in (render.resolution_x, render.resolution_y)
    )
    data, tall = ob.data, render.pixel_aspect_y / render.pixel_aspect_x
    fits_width = data.sensor_fit == "HORIZONTAL" or (data.sensor_fit == "AUTO" and width >= height * tall)
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    fitted = 1.0 if fits_width else height * tall / width  # in picture widths
    lens = Lens(data.lens * fitted * SENSOR_WIDTH / sensor, data.shift_x * fitted, data.shift_y * fitted, (1.0, tall))
    at, turned, _ = ob.matrix_world.decompose()  # a camera's size does not matter
    return camera_from(lens, np.array(Matrix.LocRotScale(at, turned, None)), width, height)


def place_camera_path(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, frames: Sequence[PosedFrame], places: Sequence[int]
) -> bpy.types.Object:
    """A camera with one key for each frame, at these places on the timeline: an animation that other programs can read.

    Between two frames the pose moves linearly, for motion blur. The lens jumps, because it is another picture's. Keys
    that the user set on the camera are removed.
    """
    ob = place_camera(owned, parent, PATH, "Camera path", frames[0].camera)
    ob.rotation_mode, ob.scale = "QUATERNION", (1.0, 1.0, 1.0)
    times = np.array(places, np.float64)
    matrices = [Matrix(object_matrix(frame.camera).tolist()) for frame in frames]
    lenses = [lens_of(frame.camera) for frame in frames]
    moving, zooming = (_new_action(owned, part) for part in ("pose", "lens"))
    add_keys(ob, moving, "location", times, np.array([matrix.translation for matrix in matrices]), "LINEAR")
    turns = _continuous(np.array([matrix.to_quaternion() for matrix in matrices]))
    add_keys(ob, moving, "rotation_quaternion", times, turns, "LINEAR")
    for path, name in (("lens", "focal_length"), ("shift_x", "shift_x"), ("shift_y", "shift_y")):
        add_keys(ob.data, zooming, path, times, np.array([getattr(lens, name) for lens in lenses]), "CONSTANT")
    return ob


def _new_action(owned: OwnedDataBlocks, part: str) -> bpy.types.Action:
    """An empty action, in place of the one from an earlier placement."""
    key = f"{PATH}:{part}"
    owned.drop("actions", key)
    action: bpy.types.Action = owned.block("actions", key, lambda: bpy.data.actions.new(f"Camera path {part}"))
    return action


def _continuous(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same rotations as quaternions [N, 4], none of them more than half a turn from the one before."""
    signs = np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    return turns * np.concatenate([[1.0], np.cumprod(signs)])[:, None]


def picture_of(frame: PosedFrame, made: Mapping[str, Path] | None = None) -> Path | None:
    """The image file that shows what the frame's camera saw; None while there is none. `made` is as in `place_frames`.
    """
    shows_itself = frame.file_shows_colour and frame.colour_path.is_file()
    return frame.colour_path if shows_itself else (made or {}).get(frame.name)


def show_photo(ob: bpy.types.Object, owned: OwnedDataBlocks, picture: Path) -> None:
    """Put a frame's photo, half transparent, in front of its camera's view: it shows whether the scene fits it."""
    # Blender reads the pixels when somebody looks through the camera.
    load = bpy.data.images.load
    image = owned.block("images", f"picture:{ob['frame']}", lambda: load(str(picture), check_existing=False))
    image.filepath = str(picture)
    put_before(ob, image, PHOTO, _PHOTO_ALPHA)


def put_before(ob: bpy.types.Object, image: bpy.types.Image, what: str, alpha: float) -> None:
    """Put an image in front of the view of a frame's camera, replacing the one there, and note `what` it is."""
    ob[SHOWN] = what
    data = ob.data
    for old in data.background_images:
        old.image = None  # else the image would still count the camera among its users
    data.background_images.clear()
    background = data.background_images.new()
    background.image = image
    background.display_depth, background.alpha = "FRONT", alpha
    # With square pixels CROP is right in scenes of any shape; else only stretching is, once the scene has the aspect.
    squareness = ob["fx"] / ob["fy"]
    background.frame_method = "CROP" if abs(squareness - 1.0) < 1e-3 else "STRETCH"
    background.show_expanded = False
    data.show_background_images = True
