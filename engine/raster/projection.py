"""3D Gaussians to records on the image plane (EWA splatting).

Everything is in double: this is cheap compared with the blending, and thin Gaussians need it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, device_function, parallel_kernel
from .arrays import Gaussians, Projected, Size
from .conventions import (
    ALPHA_MIN,
    BLUR,
    CENTRE_X,
    CENTRE_X_LOW,
    DEPTH,
    L11,
    L11_LOW,
    LOG_OPACITY,
    OPACITY,
    RED,
    TILE,
    TINY_NORM,
    WHITENING,
    Pinhole,
)
from .isect_tiles import chunk_count, next_chunk

LOG2_E = math.log2(math.e)
LOG_ALPHA_MIN = math.log(ALPHA_MIN)

CAMERA = 21
"""The length of the camera array that the kernels take: rotation (0 to 8, row by row), centre (9 to 11), focal lengths
(12, 13), principal point (14, 15), near plane (16), slope limits (17 to 20: x low, x high, y low, y high)."""


def camera_array(pinhole: Pinhole) -> NDArray[np.float64]:
    """The camera in the form that the kernels take, float64 [CAMERA]."""
    numbers = (*pinhole.focal, *pinhole.principal, pinhole.near, *pinhole.slope_limits())
    return np.array((*pinhole.rotation, *pinhole.centre, *numbers))


@device_function
def camera_point(camera: Array, x: float, y: float, z: float) -> Any:
    """World to camera coordinates, in metres."""
    x -= camera[9]
    y -= camera[10]
    z -= camera[11]
    return (
        camera[0] * x + camera[1] * y + camera[2] * z,
        camera[3] * x + camera[4] * y + camera[5] * z,
        camera[6] * x + camera[7] * y + camera[8] * z,
    )


@device_function
def unit_quaternion(w: float, x: float, y: float, z: float) -> Any:
    """The normalised quaternion, and one over its norm."""
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), TINY_NORM)
    over = 1.0 / norm
    return w * over, x * over, y * over, z * over, over


@device_function
def rotation_of(w: float, x: float, y: float, z: float) -> Any:
    """The nine entries, row by row, of a unit quaternion's matrix."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@device_function
def clamped(value: float, low: float, high: float) -> Any:
    return min(max(value, low), high)


@device_function
def image_jacobian(camera: Array, x: float, y: float, z: float) -> Any:
    """The 2x3 matrix J R from world offsets to pixels at camera point (x, y, z), and the clamped slopes x/z and y/z."""
    over_z = 1.0 / z
    u = clamped(x * over_z, camera[17], camera[18])
    v = clamped(y * over_z, camera[19], camera[20])
    jx = camera[12] * over_z
    jy = camera[13] * over_z
    return (
        jx * (camera[0] - u * camera[6]),
        jx * (camera[1] - u * camera[7]),
        jx * (camera[2] - u * camera[8]),
        jy * (camera[3] - v * camera[6]),
        jy * (camera[4] - v * camera[7]),
        jy * (camera[5] - v * camera[8]),
        u,
        v,
    )


@device_function
def axes_on_image(jacobian: tuple[float, ...], rotation: tuple[float, ...], sx: float, sy: float, sz: float) -> Any:
    """The 2x3 matrix J R Q diag(s): the Gaussian's axes, scaled, in pixels."""
    j0, j1, j2, j3, j4, j5, _, _ = jacobian
    q0, q1, q2, q3, q4, q5, q6, q7, q8 = rotation
    return (
        (j0 * q0 + j1 * q3 + j2 * q6) * sx,
        (j0 * q1 + j1 * q4 + j2 * q7) * sy,
        (j0 * q2 + j1 * q5 + j2 * q8) * sz,
        (j3 * q0 + j4 * q3 + j5 * q6) * sx,
        (j3 * q1 + j4 * q4 + j5 * q7) * sy,
        (j3 * q2 + j4 * q5 + j5 * q8) * sz,
    )


@device_function
def three_of(rows: Array, i: int) -> Any:
    """The first three numbers of row i, in double."""
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2])


@device_function
def quaternion_of(quats: Array, i: int) -> Any:
    """Row i normalised, and one over its norm."""
    w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    return unit_quaternion(w, x, y, z)


@device_function
def footprint_of(i: int, point: tuple[float, float, float], gaussians: Gaussians, camera: Array) -> Any:
    """Centre (x, y) in pixels and covariance (xx, xy, yy) in pixels squared of a Gaussian at a camera point."""
    x, y, z = point
    w, qx, qy, qz, _ = quaternion_of(gaussians.quats, i)
    sx, sy, sz = three_of(gaussians.scales, i)
    jacobian = image_jacobian(camera, x, y, z)
    a0, a1, a2, b0, b1, b2 = axes_on_image(jacobian, rotation_of(w, qx, qy, qz), sx, sy, sz)
    return (
        camera[12] * x / z + camera[14],
        camera[13] * y / z + camera[15],
        a0 * a0 + a1 * a1 + a2 * a2 + BLUR,
        a0 * b0 + a1 * b1 + a2 * b2,
        b0 * b0 + b1 * b1 + b2 * b2 + BLUR,
    )


@device_function
def clear(i: int, out: Projected) -> None:
    """Mark Gaussian i as not visible."""
    out.boxes[i, 0] = out.boxes[i, 1] = out.boxes[i, 2] = out.boxes[i, 3] = 0
    out.means2d[i, 0] = out.means2d[i, 1] = np.float32(0.0)
    out.visible[i] = False


@device_function
def project_gaussian(i: int, gaussians: Gaussians, camera: Array, size: Size, out: Projected) -> None:
    """Project one Gaussian."""
    clear(i, out)
    opacity = np.float64(gaussians.opacities[i])
    x, y, z = camera_point(camera, *three_of(gaussians.means, i))
    if not (z > camera[16] and opacity >= ALPHA_MIN):
        return
    centre_x, centre_y, cov_xx, cov_xy, cov_yy = footprint_of(i, (x, y, z), gaussians, camera)
    reach = math.log(opacity / ALPHA_MIN)
    extent_x, extent_y = math.sqrt(2.0 * reach * cov_xx), math.sqrt(2.0 * reach * cov_yy)
    right, bottom = size.width - 1.0, size.height - 1.0
    low_x, high_x = max(np.ceil(centre_x - extent_x - 0.5), 0.0), min(np.floor(centre_x + extent_x - 0.5), right)
    low_y, high_y = max(np.ceil(centre_y - extent_y - 0.5), 0.0), min(np.floor(centre_y + extent_y - 0.5), bottom)
    determinant = cov_xx * cov_yy - cov_xy * cov_xy
    if not (determinant > 0.0 and low_x <= high_x and low_y <= high_y):
        return
    boxes = out.boxes
    boxes[i, 0], boxes[i, 1] = int(low_x) // TILE, int(high_x) // TILE + 1
    boxes[i, 2], boxes[i, 3] = int(low_y) // TILE, int(high_y) // TILE + 1
    out.depths[i] = z
    out.visible[i] = True
    out.means2d[i, 0], out.means2d[i, 1] = centre_x, centre_y
    root = math.sqrt(cov_yy / determinant)
    whitened = (WHITENING * root, -WHITENING * cov_xy / (determinant * root), WHITENING / math.sqrt(cov_yy))
    write_record(i, (centre_x, centre_y), whitened, gaussians, out.records)
    out.records[i, LOG_OPACITY] = (reach + LOG_ALPHA_MIN) * LOG2_E
    out.records[i, DEPTH] = z


@device_function
def write_record(
    i: int,
    centre: tuple[float, float],
    whitened: tuple[float, float, float],
    gaussians: Gaussians,
    records: Array,
) -> None:
    """Write all of a record except ``LOG_OPACITY`` and ``DEPTH``."""
    for c in range(2):
        records[i, CENTRE_X + 2 * c] = centre[c]
        records[i, CENTRE_X_LOW + 2 * c] = centre[c] - np.float64(records[i, CENTRE_X + 2 * c])
    for c in range(3):
        records[i, L11 + c] = whitened[c]
        records[i, L11_LOW + c] = whitened[c] - np.float64(records[i, L11 + c])
        records[i, RED + c] = gaussians.colours[i, c]
    records[i, OPACITY] = gaussians.opacities[i]


@parallel_kernel
def project(
    worker: int, workers: int, gaussians: Gaussians, camera: Array, size: Size, out: Projected, next_one: Array
) -> None:
    """Project one chunk after another until none is left. ``camera`` float64 [CAMERA]; ``next_one`` int64 [1] is the
    next chunk to take."""
    count = gaussians.means.shape[0]
    chunks = chunk_count(count)
    first, end = next_chunk(next_one, chunks, count)
    while first < end:
        for i in range(first, end):
            project_gaussian(i, gaussians, camera, size, out)
        first, end = next_chunk(next_one, chunks, count)
