"""Convert the engine's cameras to Blender's: a scene's frames as camera objects with their photos in front of the view,
one moving camera, and one that overlooks a room.

Blender's camera looks along -z with y up: OpenCV's axes with y and z reversed. Its intrinsics are a focal length and a
sensor width in millimetres, and a shift in picture widths. We always fit the width (sensor_fit HORIZONTAL), so portrait
pictures and off-centre principal points need no special case. If fx and fy differ, pixels are not square, which in
Blender is a setting of the scene: its pixel aspect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..engine.job.cameras import Projection
from ..engine.posed import Camera
from ..engine.posed.frames import PosedFrame
from .compat import add_keys
from .owned import OwnedDataBlocks

SENSOR_WIDTH = 36.0
"""Millimetres. Any width gives the same picture; with this one `lens` is a full-frame focal length."""

_TURN = np.diag([1.0, -1.0, -1.0, 1.0])

OVERVIEW_SIZE = 1280, 800
"""Width and height of the overview's picture in pixels."""
_ELEVATION = np.radians(42.0)  # angle by which the overview looks down
_FOCAL_WIDTHS = 1.45
"""Focal length in picture widths: a 52 mm lens, which keeps the walls nearly upright."""
_MARGIN = 0.88  # fraction of the picture that the points fill
_DIRECTIONS = 16  # directions around the room that are tried
_STRAY, _BEYOND = 1.0, 0.06
"""Outliers: this percentage of the points at each end, if they lie farther out than this fraction of the others'
extent. Sensor noise reaches metres out of a room."""
_ENOUGH = 100_000
"""The overview is fitted to at most this many points: if there are more, to every n-th."""
_DEFAULT_ROOM = np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.5]])


@dataclass(frozen=True)
class Lens:
    """Intrinsics in Blender's terms: focal length in millimetres on a sensor of SENSOR_WIDTH, shifts in picture widths,
    and the scene's pixel aspect."""

    focal_length: float
    shift_x: float
    shift_y: float
    pixel_aspect: tuple[float, float]


def lens_of(camera: Camera) -> Lens:
    """Return the lens that gives exactly the camera's picture, even if off-centre or with fx != fy."""
    aspect = camera.fx / camera.fy
    return Lens(
        focal_length=camera.fx * SENSOR_WIDTH / camera.width,
        shift_x=(camera.width / 2.0 - camera.cx) / camera.width,
        shift_y=(camera.cy - camera.height / 2.0) / camera.width * aspect,
        pixel_aspect=pixel_aspect(camera.fx, camera.fy),
    )


def pixel_aspect(fx: float, fy: float) -> tuple[float, float]:
    """Return the scene's pixel aspect for focal lengths in pixels. Blender accepts no component below 1."""
    return (1.0, fx / fy) if fx >= fy else (fy / fx, 1.0)


def object_matrix(camera: Camera) -> NDArray[np.float64]:
    """Return `matrix_world` of the camera object, float64 [4, 4] metres."""
    return camera.camera_to_world @ _TURN


def camera_from(
    lens: Lens, matrix: NDArray[np.float64], width: int, height: int, projection: Projection = "perspective"
) -> Camera:
    """The engine's camera for a lens, an object matrix float64 [4, 4], and a picture size: the inverse of `lens_of`."""
    aspect = lens.pixel_aspect[1] / lens.pixel_aspect[0]
    fx = lens.focal_length * width / SENSOR_WIDTH
    cx = width / 2.0 - lens.shift_x * width
    cy = height / 2.0 + lens.shift_y * width / aspect
    return Camera(width, height, fx, fx / aspect, cx, cy, np.asarray(matrix, np.float64) @ _TURN, projection)


def overview_camera(xyz: NDArray[np.floating], normals: NDArray[np.floating]) -> Camera:
    """Return a camera outside and above points [N, 3] in metres, whose picture of OVERVIEW_SIZE shows all points that
    face it. It stands on the side that most points face. `normals` [N, 3] are zero where unknown."""
    if not len(xyz):
        xyz, normals = _DEFAULT_ROOM, np.zeros_like(_DEFAULT_ROOM)
    step = 1 + len(xyz) // _ENOUGH
    xyz, normals = xyz[::step].astype(np.float64), normals[::step]
    axes = max(
        (_axes(2.0 * np.pi * step / _DIRECTIONS) for step in range(_DIRECTIONS)),
        key=lambda candidate: int(np.count_nonzero(normals @ candidate[:, 2] < -0.2)),  # not edge-on
    )
    facing = normals @ axes[:, 2] <= 0.0
    return _framed(axes, xyz[facing] if facing.any() else xyz)


def _axes(azimuth: float) -> NDArray[np.float64]:
    """Return right, down and forward, the columns of float64 [3, 3], of a camera looking down from an azimuth."""
    flat = -np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = flat * np.cos(_ELEVATION) + np.array([0.0, 0.0, -np.sin(_ELEVATION)])
    right = np.array([flat[1], -flat[0], 0.0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _framed(axes: NDArray[np.float64], xyz: NDArray[np.float64]) -> Camera:
    """Return a camera with these axes [3, 3], centred on points [N, 3] and just far enough back to show them all."""
    width, height = OVERVIEW_SIZE
    focal = _FOCAL_WIDTHS * width
    half = np.array([width, height]) / 2.0 * _MARGIN / focal
    local = xyz @ axes
    # A point at depth d is inside while |offset from the axis| <= half * d. So the outermost points on either side
    # decide where the axis runs and how far back the camera stands. A few stray points must not count.
    right, left = local[:, :2] - half * local[:, 2:], local[:, :2] + half * local[:, 2:]
    right_most, left_most = (np.percentile(each, at, axis=0) for each, at in ((right, 100.0 - _STRAY), (left, _STRAY)))
    beyond = _BEYOND * np.ptp(np.percentile(local[:, :2], (_STRAY, 100.0 - _STRAY), axis=0), axis=0)
    right_most = np.minimum(right_most + beyond, right.max(axis=0))
    left_most = np.maximum(left_most - beyond, left.min(axis=0))
    back = float(((right_most - left_most) / (2.0 * half)).max())
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = axes @ [*((right_most + left_most) / 2.0), -back]
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose)


SHOWN, PHOTO = "plgs_shown", "PHOTO"
"""Property of a frame's camera: which picture is in front of its view; and its value for the photo."""
PATH = "camera_path"
"""Key of the moving camera in its lift."""

_DISPLAY_SIZE = 0.15  # metres: small enough to tell cameras apart between furniture
_PHOTO_ALPHA = 0.5


def place_camera(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    *,
    camera: Camera,
    display_size: float = _DISPLAY_SIZE,
) -> bpy.types.Object:
    """Return our camera object `key` with an engine camera's lens and pose, made in `parent` if missing. `display_size`
    is how large it is drawn, in metres."""
    data = owned.data(key, lambda: bpy.data.cameras.new(name))
    set_lens(data, camera)
    data.display_size = display_size
    ob = owned.object(key, name, data, parent)
    ob.matrix_world = Matrix(object_matrix(camera).tolist())
    return ob


def set_lens(data: bpy.types.Camera, camera: Camera) -> None:
    """Give a Blender camera these intrinsics, except picture size and pixel aspect, which belong to the scene."""
    lens = lens_of(camera)
    data.type, data.lens_unit, data.sensor_fit = "PERSP", "MILLIMETERS", "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.lens, data.shift_x, data.shift_y = lens.focal_length, lens.shift_x, lens.shift_y
    data.clip_start, data.clip_end = 0.01, 1000.0  # Blender's own 0.1 m would cut off what is near


def place_frames(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    frames: Sequence[PosedFrame],
    made: Mapping[str, Path] | None = None,
    *,
    shows_photo: bool = True,
) -> list[bpy.types.Object]:
    """Place one camera per frame in `parent`, with the frame's data as properties and, perhaps hidden, its photo in
    front of the view. `made` gives pictures, by frame name, that an engine made for frames without an image file.
    ``shows_photo``: photos are not hidden."""
    cameras = []
    for frame in frames:
        ob = place_camera(owned, parent, f"frame:{frame.name}", frame.name, camera=frame.camera)
        ob["frame"], ob["held_out"] = frame.name, bool(frame.held_out)
        for name, kind in (("width", int), ("height", int), ("fx", float), ("fy", float), ("cx", float), ("cy", float)):
            ob[name] = kind(getattr(frame.camera, name))
        picture = picture_of(frame, made)
        if picture is not None:
            show_photo(ob, owned, picture)
        ob.data.show_background_images = shows_photo
        cameras.append(ob)
    return cameras


def camera_seen(scene: bpy.types.Scene) -> Camera | None:
    """Return the view of the scene's active camera; None without one, if it is mirrored, or if not in perspective."""
    ob = scene.camera
    if ob is None or ob.type != "CAMERA" or ob.data.type != "PERSP" or ob.matrix_world.is_negative:
        return None
    return seen_by(ob, scene.render)


def seen_by(ob: bpy.types.Object, render: bpy.types.RenderSettings) -> Camera:
    """Return the view of a perspective, orthographic or equirectangular camera at the render's resolution."""
    width, height = (
        max(1, side * render.resolution_percentage // 100) for side in (render.resolution_x, render.resolution_y)
    )
    data, tall = ob.data, render.pixel_aspect_y / render.pixel_aspect_x
    fits_width = data.sensor_fit == "HORIZONTAL" or (data.sensor_fit == "AUTO" and width >= height * tall)
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    fitted = 1.0 if fits_width else height * tall / width  # in picture widths
    at, turned, _ = ob.matrix_world.decompose()  # a camera's size does not matter
    matrix = np.array(Matrix.LocRotScale(at, turned, None))
    if data.type == "PANO":
        limits = panorama_of(ob)
        fx, fy = (
            width / (limits.longitude_max - limits.longitude_min),
            height / (limits.latitude_max - limits.latitude_min),
        )
        middle = -limits.longitude_min * fx - data.shift_x * width, limits.latitude_max * fy + data.shift_y * height
        return Camera(width, height, fx, fy, *middle, matrix @ _TURN, "equirectangular")
    is_parallel = data.type == "ORTHO"
    focal_length = (
        SENSOR_WIDTH * fitted / data.ortho_scale if is_parallel else data.lens * fitted * SENSOR_WIDTH / sensor
    )
    lens = Lens(focal_length, data.shift_x * fitted, data.shift_y * fitted, (1.0, tall))
    return camera_from(lens, matrix, width, height, "orthographic" if is_parallel else "perspective")


def panorama_of(ob: bpy.types.Object) -> Any:
    """Return the settings of a panoramic camera (before Blender 5, Cycles' settings); None if Blender has none."""
    return ob.data if hasattr(ob.data, "panorama_type") else getattr(ob.data, "cycles", None)


def place_camera_path(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, frames: Sequence[PosedFrame], times: Sequence[int]
) -> bpy.types.Object:
    """Place a camera with one key per frame, at these ``times`` of the timeline: an animation that other programs can
    read. The pose moves linearly between frames, for motion blur. The lens jumps, because each picture has its own.
    Keys that the user set on the camera are removed."""
    ob = place_camera(owned, parent, PATH, "Camera path", camera=frames[0].camera)
    ob.rotation_mode, ob.scale = "QUATERNION", (1.0, 1.0, 1.0)
    keys = np.array(times, np.float64)
    matrices = [Matrix(object_matrix(frame.camera).tolist()) for frame in frames]
    lenses = [lens_of(frame.camera) for frame in frames]
    moving, zooming = (_new_action(owned, part) for part in ("pose", "lens"))
    add_keys(
        ob, moving, "location", frames=keys, values=np.array([matrix.translation for matrix in matrices]),
        interpolation="LINEAR",
    )  # fmt: skip
    turns = np.array([matrix.to_quaternion() for matrix in matrices])
    signs = np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    turns *= np.concatenate([[1.0], np.cumprod(signs)])[:, None]  # none more than half a turn from the one before
    add_keys(ob, moving, "rotation_quaternion", frames=keys, values=turns, interpolation="LINEAR")
    for path, name in (("lens", "focal_length"), ("shift_x", "shift_x"), ("shift_y", "shift_y")):
        add_keys(
            ob.data, zooming, path, frames=keys, values=np.array([getattr(lens, name) for lens in lenses]),
            interpolation="CONSTANT",
        )  # fmt: skip
    return ob


def _new_action(owned: OwnedDataBlocks, part: str) -> bpy.types.Action:
    """Return a new, empty action for ``part``, which replaces the action of an earlier placement."""
    key = f"{PATH}:{part}"
    owned.drop("actions", key)
    action: bpy.types.Action = owned.block("actions", key, lambda: bpy.data.actions.new(f"Camera path {part}"))
    return action


def picture_of(frame: PosedFrame, made: Mapping[str, Path] | None = None) -> Path | None:
    """The image file of what the frame's camera saw; None if there is none yet. `made` is as in `place_frames`."""
    shows_itself = frame.file_shows_colour and frame.colour_path.is_file()
    return frame.colour_path if shows_itself else (made or {}).get(frame.name)


def show_photo(ob: bpy.types.Object, owned: OwnedDataBlocks, picture: Path, *, asked: bool = False) -> None:
    """Put a frame's photo in front of its camera's view. If a user ``asked`` for it, it is opaque until they ask again;
    otherwise it is half transparent, to compare it with the scene."""
    before = ob.data.background_images[0].alpha if ob.get(SHOWN) == PHOTO and ob.data.background_images else 0.0
    # Blender reads the pixels when somebody looks through the camera.
    load = bpy.data.images.load
    image = owned.block("images", f"picture:{ob['frame']}", lambda: load(str(picture), check_existing=False))
    image.filepath = str(picture)
    put_before(ob, image, PHOTO, 1.0 if asked and before < 1.0 else _PHOTO_ALPHA)


def put_before(ob: bpy.types.Object, image: bpy.types.Image, what: str, alpha: float) -> None:
    """Replace the image in front of a frame camera's view, and record `what` it shows. `alpha` is its opacity."""
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
