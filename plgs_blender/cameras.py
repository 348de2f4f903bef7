"""The engine's cameras in Blender's terms. Plain numbers: `frames` puts them into data-blocks.

Blender's camera looks along -z with y up, so its axes are OpenCV's with y and z turned round. Its picture is
given by the focal length on a sensor, in millimetres, and by a shift of the sensor, in widths of the picture.
We always fit the width (sensor_fit HORIZONTAL): then portrait pictures and off-centre principal points need
no special case. fx and fy that differ are pixels that are not square; in Blender that belongs to the scene,
as pixel aspect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..engine.scene.camera import Camera

SENSOR_WIDTH = 36.0
"""Millimetres. Any width gives the same picture; this one makes `lens` read as a full-frame focal length."""

_TURN = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Lens:
    """Focal length in millimetres on a sensor of SENSOR_WIDTH, shifts in picture widths, pixel aspect of the
    scene.
    """

    focal_length: float
    shift_x: float
    shift_y: float
    pixel_aspect: tuple[float, float]


def lens_of(camera: Camera) -> Lens:
    """The lens that gives the camera's picture exactly, off-centre and with fx != fy too."""
    aspect = camera.fx / camera.fy
    return Lens(
        focal_length=camera.fx * SENSOR_WIDTH / camera.width,
        shift_x=(camera.width / 2.0 - camera.cx) / camera.width,
        shift_y=(camera.cy - camera.height / 2.0) / camera.width * aspect,
        # Blender takes no pixel aspect below 1.
        pixel_aspect=(1.0, aspect) if aspect >= 1.0 else (1.0 / aspect, 1.0),
    )


def object_matrix(camera: Camera) -> NDArray[np.float64]:
    """`matrix_world` of the camera object, float64 [4, 4] metres."""
    return camera.camera_to_world @ _TURN


def camera_from(lens: Lens, matrix: NDArray[np.float64], width: int, height: int) -> Camera:
    """The engine's camera for a lens, an object matrix, float64 [4, 4], and a picture size: `lens_of`
    backwards.
    """
    aspect = lens.pixel_aspect[1] / lens.pixel_aspect[0]
    fx = lens.focal_length * width / SENSOR_WIDTH
    cx = width / 2.0 - lens.shift_x * width
    cy = height / 2.0 + lens.shift_y * width / aspect
    return Camera(width, height, fx, fx / aspect, cx, cy, np.asarray(matrix, np.float64) @ _TURN)
