"""3D Gaussians to records on the image plane (EWA splatting), sixteen side by side."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...machine.atomics import fetch_add
from ...machine.compiled import Array, device_function, parallel_kernel
from ..arrays import Blocks, Gaussians, Projected, Size
from ..chunks import chunk_range
from ..conventions import ALPHA_MIN, BLUR, TINY_NORM, Pinhole
from ..records import (
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
from .lanes import LANES, MEAN, OTHERS, SCALE, WHO, load_lane, quaternion_in, three_of

LOG2_E = math.log2(math.e)
LOG_ALPHA_MIN = math.log(ALPHA_MIN)

# the other rows of a block, from which place on
REACH = OTHERS  # ln(opacity / ALPHA_MIN)
Z = REACH + LANES
SEEN = Z + LANES  # one or zero
LOW = SEEN + LANES  # the first pixels of the footprint, x and y
HIGH = LOW + 2 * LANES  # the last ones
CENTRE = HIGH + 2 * LANES
WHITENED = CENTRE + 2 * LANES  # L11, L12, L22
PROJECTION_BLOCK = WHITENED + 3 * LANES
"""Doubles of a block."""

CAMERA = 21
"""Numbers of the camera array that the kernels take: rotation (0 to 8, row by row), centre (9 to 11), focal lengths
(12, 13), principal point (14, 15), near plane (16), slope limits (17 to 20: x low, x high, y low, y high)."""


def camera_array(pinhole: Pinhole) -> NDArray[np.float64]:
    """The camera as the kernels take it, float64 [CAMERA]."""
    numbers = (*pinhole.focal, *pinhole.principal, pinhole.near, *pinhole.slope_limits())
    return np.array((*pinhole.rotation, *pinhole.centre, *numbers))


@device_function
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
def project_block(camera: Array, width: int, height: int, block: Array) -> None:
    """The projection of all lanes of a block; lanes that hold no Gaussian may hold anything."""
    right, bottom = width - 1.0, height - 1.0
    for lane in range(LANES):
        mean_x, mean_y, mean_z = three_of(MEAN, lane, block)
        x, y, z = camera_point(camera, mean_x, mean_y, mean_z)
        jacobian = image_jacobian(camera, x, y, z)
        centre_x = camera[12] * x / z + camera[14]
        centre_y = camera[13] * y / z + camera[15]
        w, qx, qy, qz, _ = unit_quaternion(*quaternion_in(lane, block))
        rotation = rotation_of(w, qx, qy, qz)
        sx, sy, sz = three_of(SCALE, lane, block)
        a0, a1, a2, b0, b1, b2 = axes_on_image(jacobian, rotation, sx, sy, sz)
        cov_xx = a0 * a0 + a1 * a1 + a2 * a2 + BLUR
        cov_xy = a0 * b0 + a1 * b1 + a2 * b2
        cov_yy = b0 * b0 + b1 * b1 + b2 * b2 + BLUR
        determinant = cov_xx * cov_yy - cov_xy * cov_xy
        reach = block[REACH + lane]
        extent_x = math.sqrt(2.0 * reach * cov_xx)
        extent_y = math.sqrt(2.0 * reach * cov_yy)
        low_x, high_x = max(np.ceil(centre_x - extent_x - 0.5), 0.0), min(np.floor(centre_x + extent_x - 0.5), right)
        low_y, high_y = max(np.ceil(centre_y - extent_y - 0.5), 0.0), min(np.floor(centre_y + extent_y - 0.5), bottom)
        seen = (determinant > 0.0) & (low_x <= high_x) & (low_y <= high_y)
        root = math.sqrt(cov_yy / determinant)
        block[SEEN + lane] = 1.0 if seen else 0.0
        block[LOW + lane] = low_x
        block[LOW + LANES + lane] = low_y
        block[HIGH + lane] = high_x
        block[HIGH + LANES + lane] = high_y
        block[CENTRE + lane] = centre_x
        block[CENTRE + LANES + lane] = centre_y
        block[WHITENED + lane] = WHITENING * root
        block[WHITENED + LANES + lane] = -WHITENING * cov_xy / (determinant * root)
        block[WHITENED + 2 * LANES + lane] = WHITENING / math.sqrt(cov_yy)


@device_function
def store_lanes(lanes: int, block: Array, gaussians: Gaussians, out: Projected) -> Any:
    """What is visible of so many Gaussians goes to its place; returns how many that are, and how many tiles they
    touch."""
    boxes, records = out.boxes, out.records
    shown, touched = 0, 0
    for lane in range(lanes):
        if block[SEEN + lane] == 0.0:
            continue
        i = int(block[WHO + lane])
        boxes[i, 0] = int(block[LOW + lane]) // TILE
        boxes[i, 1] = int(block[HIGH + lane]) // TILE + 1
        boxes[i, 2] = int(block[LOW + LANES + lane]) // TILE
        boxes[i, 3] = int(block[HIGH + LANES + lane]) // TILE + 1
        shown += 1
        touched += (boxes[i, 1] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 2])
        out.depths[i] = block[Z + lane]
        out.visible[i] = True
        centre_x, centre_y = block[CENTRE + lane], block[CENTRE + LANES + lane]
        l11, l12, l22 = three_of(WHITENED, lane, block)
        out.means2d[i, 0] = records[i, CENTRE_X] = centre_x
        out.means2d[i, 1] = records[i, CENTRE_Y] = centre_y
        records[i, CENTRE_X_LOW] = centre_x - np.float64(records[i, CENTRE_X])
        records[i, CENTRE_Y_LOW] = centre_y - np.float64(records[i, CENTRE_Y])
        records[i, L11] = l11
        records[i, L12] = l12
        records[i, L22] = l22
        records[i, L11_LOW] = l11 - np.float64(records[i, L11])
        records[i, L12_LOW] = l12 - np.float64(records[i, L12])
        records[i, L22_LOW] = l22 - np.float64(records[i, L22])
        records[i, OPACITY] = gaussians.opacities[i]
        records[i, LOG_OPACITY] = (block[REACH + lane] + LOG_ALPHA_MIN) * LOG2_E
        records[i, RED] = gaussians.colours[i, 0]
        records[i, GREEN] = gaussians.colours[i, 1]
        records[i, BLUE] = gaussians.colours[i, 2]
        records[i, DEPTH] = block[Z + lane]
    return shown, touched


@device_function
def project_chunk(
    first: int, end: int, block: Array, gaussians: Gaussians, camera: Array, size: Size, out: Projected
) -> Any:
    """Project the Gaussians from ``first`` to before ``end``; returns how many are visible, and how many tiles they
    touch. ``block`` float64 [PROJECTION_BLOCK] is room to work in."""
    means, shown, touched, lanes = gaussians.means, 0, 0, 0
    for i in range(first, end):
        out.boxes[i, 0] = out.boxes[i, 1] = out.boxes[i, 2] = out.boxes[i, 3] = 0
        out.means2d[i, 0] = out.means2d[i, 1] = np.float32(0.0)
        out.visible[i] = False
        opacity = np.float64(gaussians.opacities[i])
        _, _, z = camera_point(camera, np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2]))
        if not (z > camera[16] and opacity >= ALPHA_MIN):
            continue
        load_lane(i, lanes, gaussians, block)
        block[REACH + lanes] = math.log(opacity / ALPHA_MIN)
        block[Z + lanes] = z
        lanes += 1
        if lanes == LANES:
            project_block(camera, size.width, size.height, block)
            now = store_lanes(lanes, block, gaussians, out)
            shown, touched, lanes = shown + now[0], touched + now[1], 0
    if lanes > 0:
        project_block(camera, size.width, size.height, block)
        now = store_lanes(lanes, block, gaussians, out)
        shown, touched = shown + now[0], touched + now[1]
    return shown, touched


@parallel_kernel
def project(
    worker: int,
    workers: int,
    gaussians: Gaussians,
    camera: Array,
    size: Size,
    out: Projected,
    counts: Array,
    blocks: Blocks,
) -> None:
    """Chunk after chunk until none is left. ``camera`` float64 [CAMERA]; ``counts`` int64 [chunks, 2] gets what
    ``project_chunk`` returns of each."""
    chunks, block = counts.shape[0], blocks.rows[worker]
    while True:
        chunk = fetch_add(blocks.next_one)
        if chunk >= chunks:
            break
        first, end = chunk_range(chunk, chunks, gaussians.means.shape[0])
        counts[chunk, 0], counts[chunk, 1] = project_chunk(first, end, block, gaussians, camera, size, out)
