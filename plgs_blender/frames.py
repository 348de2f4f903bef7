"""A scene's frames as camera objects, with their pictures behind (or rather before) the view and on the
timeline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..engine.scene import Camera, Frame
from .cameras import SENSOR_WIDTH, Lens, camera_from, lens_of, object_matrix
from .owned import OwnedDataBlocks, key_of, text_of

FIRST_FRAME = "plgs_first_frame"
"""Property of a lift's collection: where on the timeline its first frame lies."""

DISPLAY_SIZE = 0.15  # metres: the camera path stays readable between furniture


SHOWN, PHOTO = "plgs_shown", "PHOTO"
"""Property of a frame's camera: what is before its view; its photo, where nothing else was asked for."""

_PHOTO_ALPHA = 0.5


def place_frames(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    frames: Sequence[Frame],
    made: Mapping[str, Path] | None = None,
) -> list[bpy.types.Object]:
    """One camera a frame in `parent`: exact lens and pose, the colour image in view, what is known as
    properties. `made` are pictures by frame name that an engine made where no image file shows them.
    """
    cameras = []
    for frame in frames:
        key = f"frame:{frame.name}"
        data = owned.data_of(key) or _new_camera(owned, key, frame.name)
        set_lens(data, frame.camera)
        data.display_size = DISPLAY_SIZE
        ob = owned.object(key, frame.name, data, parent)
        ob.matrix_world = Matrix(object_matrix(frame.camera).tolist())
        _describe(ob, frame)
        picture = picture_of(frame, made)
        if picture is not None:
            show_photo(ob, owned, picture)
        cameras.append(ob)
    return cameras


def set_lens(data: bpy.types.Camera, camera: Camera) -> None:
    """Give a Blender camera the engine camera's intrinsics. Size and pixel aspect are the scene's, and the user's."""
    lens = lens_of(camera)
    data.type, data.lens_unit, data.sensor_fit = "PERSP", "MILLIMETERS", "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.lens, data.shift_x, data.shift_y = lens.focal_length, lens.shift_x, lens.shift_y
    data.clip_start, data.clip_end = 0.01, 1000.0


def camera_seen(scene: bpy.types.Scene) -> Camera | None:
    """What the scene's active camera sees, whoever made it, in a picture of the scene's size; None without one in
    perspective, and for one that shows the world mirrored.
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
    lens = Lens(
        data.lens * fitted * SENSOR_WIDTH / sensor, data.shift_x * fitted, data.shift_y * fitted, (1.0, tall)
    )
    at, turned, _ = ob.matrix_world.decompose()  # a camera's size does not matter
    return camera_from(lens, np.array(Matrix.LocRotScale(at, turned, None)), width, height)


def mark_timeline(
    scene: bpy.types.Scene,
    root: bpy.types.Collection,
    lift: str,
    overview: bpy.types.Object | None,
    cameras: Sequence[bpy.types.Object],
) -> int:
    """A marker for the overview, where there is one, and one for each frame, bound to their cameras. Returns where on
    the timeline the first frame lies.

    Scrubbing walks through them.

    Ours are the markers bound to our cameras. A scene that already has a camera of the user's keeps it: then
    ours lie behind the end of its own frames, and its camera gets a marker at the start, since the first
    bound marker rules all frames before it.
    """
    markers = scene.timeline_markers
    for marker in [m for m in markers if m.camera is not None and key_of(m.camera, lift) is not None]:
        markers.remove(marker)
    if type(root.get(FIRST_FRAME)) is not int:
        theirs = scene.camera is not None and key_of(scene.camera, lift) is None
        bound = any(marker.camera is not None for marker in markers)
        root[FIRST_FRAME] = scene.frame_end + 1 if theirs or bound else 0
        if theirs and not bound:
            markers.new(scene.camera.name, frame=scene.frame_start).camera = scene.camera
    shown = [*([overview] if overview else []), *cameras]
    for frame, camera in enumerate(shown, start=root[FIRST_FRAME]):
        markers.new(text_of(camera, "frame") or camera.name, frame=frame).camera = camera
    first: int = root[FIRST_FRAME]
    return first + len(shown) - len(cameras)


def _new_camera(owned: OwnedDataBlocks, key: str, name: str) -> bpy.types.Camera:
    return owned.new_data(bpy.data.cameras.new(name), key)


def picture_of(frame: Frame, made: Mapping[str, Path] | None = None) -> Path | None:
    """The image file that shows what the frame's camera saw; None where there is none, or not yet."""
    return frame.colour_path if frame.file_shows_colour else (made or {}).get(frame.name)


def show_photo(ob: bpy.types.Object, owned: OwnedDataBlocks, picture: Path) -> None:
    """Put a frame's photo, half transparent, before what its camera sees: it shows whether the scene fits it."""
    image = owned.block("images", f"picture:{ob['frame']}", lambda: _load(picture))
    image.filepath = str(picture)
    put_before(ob, image, PHOTO, _PHOTO_ALPHA)


def put_before(ob: bpy.types.Object, image: bpy.types.Image, what: str, alpha: float) -> None:
    """Put an image of ``what`` before what the camera of a frame sees, in place of the one that is there."""
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


def _load(path: Path) -> bpy.types.Image:
    """The image's data-block; Blender reads the pixels when somebody looks through the camera."""
    return bpy.data.images.load(str(path), check_existing=False)


def _describe(ob: bpy.types.Object, frame: Frame) -> None:
    camera = frame.camera
    ob["frame"], ob["held_out"] = frame.name, bool(frame.held_out)
    ob["width"], ob["height"] = int(camera.width), int(camera.height)
    for name in ("fx", "fy", "cx", "cy"):
        ob[name] = float(getattr(camera, name))
