"""The engine's cameras in Blender's terms, and a camera that overlooks a room. NumPy only: `frames` makes data-blocks.

Blender's camera looks along -z with y up, so its axes are OpenCV's with y and z reversed. Its picture is given by
the focal length on a sensor, in millimetres, and by a shift of the sensor, in widths of the picture. We always fit the
width (sensor_fit HORIZONTAL): then portrait pictures and off-centre principal points need no special case. Where fx and
fy differ, pixels are not square. In Blender that is a setting of the scene, its pixel aspect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..engine.posed.camera import Camera

SENSOR_WIDTH = 36.0
"""Millimetres. Any width gives the same picture; with this one `lens` is a full-frame focal length."""

_TURN = np.diag([1.0, -1.0, -1.0, 1.0])

OVERVIEW_SIZE = 1280, 800
"""Width and height of the overview's picture in pixels."""
_ELEVATION = np.radians(42.0)
"""Angle by which the overview looks down."""
_FOCAL_WIDTHS = 1.45
"""Focal length in picture widths: a 52 mm lens, which keeps the walls nearly upright."""
_MARGIN = 0.88
"""Share of the picture that the points fill."""
_DIRECTIONS = 16
"""Directions around the room that are tried."""
_STRAY, _BEYOND = 1.0, 0.06
"""Percent of the points that are stray on each side where they lie farther out than this share of what the others take
up: a sensor's noise reaches metres out of a room."""
_ENOUGH = 100_000
"""At most this many points determine the place; of more points, every n-th is used."""
_DEFAULT_ROOM = np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.5]])


@dataclass(frozen=True)
class Lens:
    """Focal length in millimetres on a sensor of SENSOR_WIDTH, shifts in picture widths, pixel aspect of the scene."""

    focal_length: float
    shift_x: float
    shift_y: float
    pixel_aspect: tuple[float, float]


def lens_of(camera: Camera) -> Lens:
    """The lens that gives exactly the camera's picture, even off-centre and with fx != fy."""
    aspect = camera.fx / camera.fy
    return Lens(
        focal_length=camera.fx * SENSOR_WIDTH / camera.width,
        shift_x=(camera.width / 2.0 - camera.cx) / camera.width,
        shift_y=(camera.cy - camera.height / 2.0) / camera.width * aspect,
        pixel_aspect=pixel_aspect(camera.fx, camera.fy),
    )


def pixel_aspect(fx: float, fy: float) -> tuple[float, float]:
    """The scene's pixel aspect for focal lengths in pixels. Blender accepts none below 1."""
    return (1.0, fx / fy) if fx >= fy else (fy / fx, 1.0)


def object_matrix(camera: Camera) -> NDArray[np.float64]:
    """`matrix_world` of the camera object, float64 [4, 4] metres."""
    return camera.camera_to_world @ _TURN


def camera_from(lens: Lens, matrix: NDArray[np.float64], width: int, height: int) -> Camera:
    """The engine's camera for a lens, an object matrix float64 [4, 4], and a picture size: the inverse of `lens_of`."""
    aspect = lens.pixel_aspect[1] / lens.pixel_aspect[0]
    fx = lens.focal_length * width / SENSOR_WIDTH
    cx = width / 2.0 - lens.shift_x * width
    cy = height / 2.0 + lens.shift_y * width / aspect
    return Camera(width, height, fx, fx / aspect, cx, cy, np.asarray(matrix, np.float64) @ _TURN)


def overview_camera(xyz: NDArray[np.floating], normals: NDArray[np.floating]) -> Camera:
    """A camera outside and above points [N, 3] in metres, whose picture of OVERVIEW_SIZE holds the points that face it.

    It stands on the side that most points face. `normals` [N, 3] are zero where they are unknown.
    """
    if not len(xyz):
        xyz, normals = _DEFAULT_ROOM, np.zeros_like(_DEFAULT_ROOM)
    step = 1 + len(xyz) // _ENOUGH
    xyz, normals = xyz[::step].astype(np.float64), normals[::step]
    axes = max(
        (_axes(2.0 * np.pi * step / _DIRECTIONS) for step in range(_DIRECTIONS)),
        key=lambda candidate: int(np.count_nonzero(normals @ candidate[:, 2] < -0.2)),
    )
    facing = normals @ axes[:, 2] <= 0.0
    return _framed(axes, xyz[facing] if facing.any() else xyz)


def _axes(azimuth: float) -> NDArray[np.float64]:
    """Right, down and forward of a camera that looks down at the room from an azimuth, the columns of float64 [3, 3].
    """
    flat = -np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = flat * np.cos(_ELEVATION) + np.array([0.0, 0.0, -np.sin(_ELEVATION)])
    right = np.array([flat[1], -flat[0], 0.0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _framed(axes: NDArray[np.float64], xyz: NDArray[np.float64]) -> Camera:
    """A camera with these axes, just far enough back for the points to fit, and centred on them."""
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
