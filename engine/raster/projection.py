"""3D Gaussians to records on the image plane (EWA splatting), and the chain rule back. All in double: it is
cheap beside the blending, and thin Gaussians need it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, part
from ..machine.shared import shared
from .conventions import ALPHA_MIN, BLUR, TINY_NORM, View
from .records import (
    BLUE,
    CENTRE_X,
    CENTRE_X_LOW,
    CENTRE_Y,
    CENTRE_Y_LOW,
    DEPTH,
    GREEN,
    L11,
    L11_LOW,
    L12,
    L12_LOW,
    L22,
    L22_LOW,
    LOG_OPACITY,
    OPACITY,
    RED,
    TILE,
    WHITENING,
)

LOG2_E = math.log2(math.e)
LOG_ALPHA_MIN = math.log(ALPHA_MIN)
ROUNDED_UP = 1.0 + 1e-9
"""What double precision may have rounded off is far less."""

CAMERA = 21
"""Numbers of the camera array that the kernels take: rotation (0 to 8, row by row), centre (9 to 11), focal lengths
(12, 13), principal point (14, 15), near plane (16), slope limits (17 to 20: x low, x high, y low, y high)."""


def camera_array(view: View) -> NDArray[np.float64]:
    """The camera as the kernels take it, float64 [CAMERA]."""
    numbers = (*view.focal, *view.principal, view.near, *view.slope_limits())
    return np.array((*view.rotation, *view.centre, *numbers))


@part
def camera_point(camera: Array, x: float, y: float, z: float) -> Any:
    """World to camera coordinates, metres."""
    x -= camera[9]
    y -= camera[10]
    z -= camera[11]
    return (
        camera[0] * x + camera[1] * y + camera[2] * z,
        camera[3] * x + camera[4] * y + camera[5] * z,
        camera[6] * x + camera[7] * y + camera[8] * z,
    )


@part
def unit_quaternion(w: float, x: float, y: float, z: float) -> Any:
    """The normalised quaternion, and one over its norm."""
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), TINY_NORM)
    over = 1.0 / norm
    return w * over, x * over, y * over, z * over, over


@part
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


@part
def clamped(value: float, low: float, high: float) -> Any:
    return min(max(value, low), high)


@part
def image_jacobian(camera: Array, x: float, y: float, z: float) -> Any:
    """The 2x3 matrix J R from world offsets to pixels at camera point (x, y, z), and the clamped slopes x/z
    and y/z."""
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


@part
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


@part
def is_out_of_reach(
    centre: float, size: int, jacobian: tuple[float, float, float], longest: float, reach: float
) -> bool:
    """Whether no pixel centre along a side of the image can be reached, whichever way the Gaussian is turned.

    Its variance along that side, metres brought to pixels by a row of the Jacobian, is at most that of a ball with its
    ``longest`` standard deviation. ``reach`` is ln(opacity / ALPHA_MIN).
    """
    beyond = max(0.5 - centre, centre - (size - 0.5))
    j0, j1, j2 = jacobian
    variance = longest * longest * (j0 * j0 + j1 * j1 + j2 * j2) + BLUR
    return beyond > 0.0 and beyond * beyond > ROUNDED_UP * 2.0 * reach * variance


@part
def project_range(
    first: int,
    last: int,
    means: Array,
    scales: Array,
    quats: Array,
    opacities: Array,
    colours: Array,
    camera: Array,
    width: int,
    height: int,
    records: Array,
    boxes: Array,
    depths: Array,
    centres: Array,
    visible: Array,
) -> Any:
    """Fill records [N, RECORD], boxes int32 [N, 4] (tile columns and rows, last ones excluded), depths [N], centres
    [N, 2] and visible bool [N] of Gaussians first to last.

    A Gaussian that is not visible gets an empty box, and its centre is zero. Returns how many are visible and how many
    tiles they touch.
    """
    shown = 0
    touched = 0
    for i in range(first, last):
        boxes[i, 0] = boxes[i, 1] = boxes[i, 2] = boxes[i, 3] = 0
        centres[i, 0] = centres[i, 1] = np.float32(0.0)
        visible[i] = False
        opacity = np.float64(opacities[i])
        x, y, z = camera_point(camera, np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2]))
        if not (z > camera[16] and opacity >= ALPHA_MIN):
            continue
        jacobian = image_jacobian(camera, x, y, z)
        centre_x = camera[12] * x / z + camera[14]
        centre_y = camera[13] * y / z + camera[15]
        sx, sy, sz = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        longest = max(abs(sx), abs(sy), abs(sz))
        reach = math.log(opacity / ALPHA_MIN)
        # most that are not visible need no more than this
        if is_out_of_reach(centre_x, width, jacobian[:3], longest, reach):
            continue
        if is_out_of_reach(centre_y, height, jacobian[3:6], longest, reach):
            continue
        w, qx, qy, qz, _ = unit_quaternion(
            np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
        )
        rotation = rotation_of(w, qx, qy, qz)
        a0, a1, a2, b0, b1, b2 = axes_on_image(jacobian, rotation, sx, sy, sz)
        cov_xx = a0 * a0 + a1 * a1 + a2 * a2 + BLUR
        cov_xy = a0 * b0 + a1 * b1 + a2 * b2
        cov_yy = b0 * b0 + b1 * b1 + b2 * b2 + BLUR
        determinant = cov_xx * cov_yy - cov_xy * cov_xy
        extent_x = math.sqrt(2.0 * reach * cov_xx)
        extent_y = math.sqrt(2.0 * reach * cov_yy)
        low_x = max(math.ceil(centre_x - extent_x - 0.5), 0.0)
        low_y = max(math.ceil(centre_y - extent_y - 0.5), 0.0)
        high_x = min(math.floor(centre_x + extent_x - 0.5), width - 1.0)
        high_y = min(math.floor(centre_y + extent_y - 0.5), height - 1.0)
        if not (determinant > 0.0 and low_x <= high_x and low_y <= high_y):
            continue
        boxes[i, 0] = int(low_x) // TILE
        boxes[i, 1] = int(high_x) // TILE + 1
        boxes[i, 2] = int(low_y) // TILE
        boxes[i, 3] = int(high_y) // TILE + 1
        centres[i, 0] = centre_x
        centres[i, 1] = centre_y
        depths[i] = z
        visible[i] = True
        shown += 1
        touched += (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])

        root = math.sqrt(cov_yy / determinant)
        records[i, CENTRE_X] = centre_x
        records[i, CENTRE_X_LOW] = centre_x - np.float64(records[i, CENTRE_X])
        records[i, CENTRE_Y] = centre_y
        records[i, CENTRE_Y_LOW] = centre_y - np.float64(records[i, CENTRE_Y])
        l11 = WHITENING * root
        l12 = -WHITENING * cov_xy / (determinant * root)
        l22 = WHITENING / math.sqrt(cov_yy)
        records[i, L11] = l11
        records[i, L12] = l12
        records[i, L22] = l22
        records[i, L11_LOW] = l11 - np.float64(records[i, L11])
        records[i, L12_LOW] = l12 - np.float64(records[i, L12])
        records[i, L22_LOW] = l22 - np.float64(records[i, L22])
        records[i, OPACITY] = opacities[i]
        records[i, LOG_OPACITY] = (reach + LOG_ALPHA_MIN) * LOG2_E
        records[i, RED] = colours[i, 0]
        records[i, GREEN] = colours[i, 1]
        records[i, BLUE] = colours[i, 2]
        records[i, DEPTH] = z
    return shown, touched


@shared
def project(
    worker: int,
    workers: int,
    means: Array,
    scales: Array,
    quats: Array,
    opacities: Array,
    colours: Array,
    camera: Array,
    width: int,
    height: int,
    records: Array,
    boxes: Array,
    depths: Array,
    centres: Array,
    visible: Array,
    counts: Array,
) -> None:
    """A worker's share of ``project_range``; counts int64 [workers, 2] gets its visible Gaussians and touched
    tiles."""
    count = means.shape[0]
    first = count * worker // workers
    last = count * (worker + 1) // workers
    shown, touched = project_range(
        first,
        last,
        means,
        scales,
        quats,
        opacities,
        colours,
        camera,
        width,
        height,
        records,
        boxes,
        depths,
        centres,
        visible,
    )
    counts[worker, 0] = shown
    counts[worker, 1] = touched
