"""Projects 3D Gaussians to the image (EWA splatting), and takes gradients on the image back to their 3D parameters.

Everything is in double precision: it is cheap compared with the blending, and thin Gaussians need it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, device_function, parallel_kernel
from . import conventions
from .arrays import GaussianGradients, Gaussians, Projected, Shapes, Size
from .conventions import ALPHA_MIN, BLUR, TILE, WHITENING, Pinhole
from .isect_tiles import chunk_count, next_chunk

LOG2_E = math.log2(math.e)
LOG_ALPHA_MIN = math.log(ALPHA_MIN)

CAMERA = 22
"""The length of the camera array that the kernels take: rotation (0 to 8, row by row), centre (9 to 11), focal lengths
(12, 13), principal point (14, 15), near plane (16), slope limits (17 to 20: x low, x high, y low, y high), 1 if it is
orthographic (21). Gradients are those of a perspective camera."""


def camera_array(pinhole: Pinhole) -> NDArray[np.float64]:
    """Return the camera as the array that kernels take, float64 [CAMERA]."""
    numbers = (
        *pinhole.focal,
        *pinhole.principal,
        pinhole.near,
        *pinhole.slope_limits(),
        float(pinhole.is_orthographic),
    )
    return np.array((*pinhole.rotation, *pinhole.centre, *numbers))


@device_function
def camera_point(camera: Array, x: float, y: float, z: float) -> Any:
    """Transform a point from world to camera coordinates, metres."""
    x -= camera[9]
    y -= camera[10]
    z -= camera[11]
    return (
        camera[0] * x + camera[1] * y + camera[2] * z,
        camera[3] * x + camera[4] * y + camera[5] * z,
        camera[6] * x + camera[7] * y + camera[8] * z,
    )


@device_function
def rotation_of(w: float, x: float, y: float, z: float) -> Any:
    """Return the rotation matrix of a unit quaternion, nine numbers row by row."""
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
    """Return the 2x3 matrix J R, from world offsets at camera point (x, y, z) to pixels, and the clamped slopes."""
    over_z = 1.0 if camera[21] > 0.0 else 1.0 / z
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
    """Return the 2x3 matrix J R Q diag(s), a Gaussian's scaled axes in pixels; ``rotation`` is Q, (sx, sy, sz) is s."""
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
    """Return the first three numbers of row i as doubles."""
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2])


@device_function
def quaternion_of(quats: Array, i: int) -> Any:
    """Return quaternion i, normalised, and 1 / its norm."""
    w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    over = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), conventions.TINY_NORM)
    return w * over, x * over, y * over, z * over, over


@device_function
def footprint_of(i: int, point: tuple[float, float, float], gaussians: Gaussians, camera: Array) -> Any:
    """Return the image centre (x, y), pixels, and covariance (xx, xy, yy), px^2, of Gaussian i at camera ``point``."""
    x, y, z = point
    w, qx, qy, qz, _ = quaternion_of(gaussians.quats, i)
    sx, sy, sz = three_of(gaussians.scales, i)
    jacobian = image_jacobian(camera, x, y, z)
    a0, a1, a2, b0, b1, b2 = axes_on_image(jacobian, rotation_of(w, qx, qy, qz), sx, sy, sz)
    if camera[21] > 0.0:
        z = 1.0
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
    """Project Gaussian i, and write its record, box, depth and 2D mean to ``out``."""
    clear(i, out)
    opacity = np.float64(gaussians.opacities[i])
    x, y, z = camera_point(camera, *three_of(gaussians.means, i))
    if not (z > camera[16] and opacity >= ALPHA_MIN):  # not "<=": so NaN is not drawn
        return
    centre_x, centre_y, cov_xx, cov_xy, cov_yy = footprint_of(i, (x, y, z), gaussians, camera)
    reach = math.log(opacity / ALPHA_MIN)
    extent_x, extent_y = math.sqrt(2.0 * reach * cov_xx), math.sqrt(2.0 * reach * cov_yy)  # where alpha falls to 1/255
    right, bottom = size.width - 1.0, size.height - 1.0  # below, 0.5 leads from a pixel's index to its centre
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
    out.records[i, conventions.LOG_OPACITY] = (reach + LOG_ALPHA_MIN) * LOG2_E  # log2(opacity)
    out.records[i, conventions.DEPTH] = z


@device_function
def write_record(
    i: int, centre: tuple[float, float], whitened: tuple[float, float, float], gaussians: Gaussians, records: Array
) -> None:
    """Write record i, without LOG_OPACITY and DEPTH, by its ``centre`` on the image; ``whitened`` is L11, L12, L22."""
    for c in range(2):
        records[i, conventions.CENTRE_X + 2 * c] = centre[c]
        records[i, conventions.CENTRE_X_LOW + 2 * c] = centre[c] - np.float64(records[i, conventions.CENTRE_X + 2 * c])
    for c in range(3):
        records[i, conventions.L11 + c] = whitened[c]
        records[i, conventions.L11_LOW + c] = whitened[c] - np.float64(records[i, conventions.L11 + c])
        records[i, conventions.RED + c] = gaussians.colours[i, c]
    records[i, conventions.OPACITY] = gaussians.opacities[i]


@parallel_kernel
def project(
    worker: int, workers: int, gaussians: Gaussians, camera: Array, size: Size, out: Projected, next_one: Array
) -> None:
    """Project all Gaussians. Each worker takes one chunk after another (``next_one`` int64 [1]) until none is left.
    ``camera`` float64 [CAMERA]."""
    count = gaussians.means.shape[0]
    chunks = chunk_count(count)
    first, end = next_chunk(next_one, chunks, count)
    while first < end:
        for i in range(first, end):
            project_gaussian(i, gaussians, camera, size, out)
        first, end = next_chunk(next_one, chunks, count)


@device_function
def gradient_on_image(record: Array, total: Array) -> Any:
    """Return dL/d(centre x, y) and dL/d(covariance xx, xy = yx, yy), from the sums ``total`` over pixels of g = dL/d(ln
    alpha) times powers of s. With A = WHITENING * L, s = A d and ln alpha = -|s|^2 / log2(e), dL/dcentre = 2 / log2(e)
    * A^T sum(g s) and dL/dcov = A^T sum(g s s^T) A / (log2(e) * WHITENING^2)."""
    a = np.float64(record[conventions.L11]) + np.float64(record[conventions.L11_LOW])
    b = np.float64(record[conventions.L12]) + np.float64(record[conventions.L12_LOW])
    c = np.float64(record[conventions.L22]) + np.float64(record[conventions.L22_LOW])
    s1, s2 = total[conventions.G_S1], total[conventions.G_S2]
    s11, s12, s22 = total[conventions.G_S1S1], total[conventions.G_S1S2], total[conventions.G_S2S2]
    first = 2.0 / LOG2_E
    d_x = first * (a * s1)
    d_y = first * (b * s1 + c * s2)
    second = 1.0 / (LOG2_E * WHITENING * WHITENING)
    d_xx = second * (a * a * s11)
    d_xy = second * (a * (b * s11 + c * s12))
    d_yy = second * (b * b * s11 + 2.0 * b * c * s12 + c * c * s22)
    return d_x, d_y, d_xx, d_xy, d_yy


@device_function
def through_clamp(value: float, low: float, high: float, d_clamped: float) -> Any:
    return d_clamped if low <= value <= high else 0.0


@device_function
def project_backward(
    i: int, total: Array, record: Array, shapes: Shapes, camera: Array, out: GaussianGradients
) -> None:
    """Take the gradients ``total`` [GRADIENT] of Gaussian i on the image, summed over its tiles, through the
    projection, and write those of its mean, scales, quaternion and 2D mean to ``out``."""
    d_x2, d_y2, d_xx, d_xy, d_yy = gradient_on_image(record, total)
    out.means2d[i, 0], out.means2d[i, 1] = d_x2, d_y2
    x, y, z = camera_point(camera, *three_of(shapes.means, i))
    jacobian = image_jacobian(camera, x, y, z)
    j0, j1, j2, j3, j4, j5, u, v = jacobian
    w, qx, qy, qz, over_norm = quaternion_of(shapes.quats, i)
    rotation = rotation_of(w, qx, qy, qz)
    q0, q1, q2, q3, q4, q5, q6, q7, q8 = rotation
    sx, sy, sz = three_of(shapes.scales, i)
    a0, a1, a2, b0, b1, b2 = axes_on_image(jacobian, rotation, sx, sy, sz)

    # cov = X X^T with X = [a; b] (2x3): dX = 2 dcov X
    da0 = 2.0 * (d_xx * a0 + d_xy * b0)
    da1 = 2.0 * (d_xx * a1 + d_xy * b1)
    da2 = 2.0 * (d_xx * a2 + d_xy * b2)
    db0 = 2.0 * (d_xy * a0 + d_yy * b0)
    db1 = 2.0 * (d_xy * a1 + d_yy * b1)
    db2 = 2.0 * (d_xy * a2 + d_yy * b2)

    # X = T Q diag(s) with T = J R (2x3): dM = T^T dX for M = Q diag(s)
    m0, m1, m2 = j0 * da0 + j3 * db0, j0 * da1 + j3 * db1, j0 * da2 + j3 * db2
    m3, m4, m5 = j1 * da0 + j4 * db0, j1 * da1 + j4 * db1, j1 * da2 + j4 * db2
    m6, m7, m8 = j2 * da0 + j5 * db0, j2 * da1 + j5 * db1, j2 * da2 + j5 * db2
    out.scales[i, 0] = m0 * q0 + m3 * q3 + m6 * q6
    out.scales[i, 1] = m1 * q1 + m4 * q4 + m7 * q7
    out.scales[i, 2] = m2 * q2 + m5 * q5 + m8 * q8
    m0, m3, m6 = m0 * sx, m3 * sx, m6 * sx
    m1, m4, m7 = m1 * sy, m4 * sy, m7 * sy
    m2, m5, m8 = m2 * sz, m5 * sz, m8 * sz
    d_w = 2.0 * (qx * (m7 - m5) + qy * (m2 - m6) + qz * (m3 - m1))
    d_qx = 2.0 * (qy * (m1 + m3) + qz * (m2 + m6) - 2.0 * qx * (m4 + m8) + w * (m7 - m5))
    d_qy = 2.0 * (qx * (m1 + m3) + qz * (m5 + m7) - 2.0 * qy * (m0 + m8) + w * (m2 - m6))
    d_qz = 2.0 * (qx * (m2 + m6) + qy * (m5 + m7) - 2.0 * qz * (m0 + m4) + w * (m3 - m1))
    along = d_w * w + d_qx * qx + d_qy * qy + d_qz * qz  # normalised, so no gradient along it
    out.quats[i, 0] = (d_w - along * w) * over_norm
    out.quats[i, 1] = (d_qx - along * qx) * over_norm
    out.quats[i, 2] = (d_qy - along * qy) * over_norm
    out.quats[i, 3] = (d_qz - along * qz) * over_norm

    # dT = dX M^T
    c0, c1, c2 = q0 * sx, q1 * sy, q2 * sz
    c3, c4, c5 = q3 * sx, q4 * sy, q5 * sz
    c6, c7, c8 = q6 * sx, q7 * sy, q8 * sz
    t0, t1, t2 = da0 * c0 + da1 * c1 + da2 * c2, da0 * c3 + da1 * c4 + da2 * c5, da0 * c6 + da1 * c7 + da2 * c8
    t3, t4, t5 = db0 * c0 + db1 * c1 + db2 * c2, db0 * c3 + db1 * c4 + db2 * c5, db0 * c6 + db1 * c7 + db2 * c8
    # T = [fx/z (R0 - u R2); fy/z (R1 - v R2)] with the clamped slopes u = x/z, v = y/z
    over_z = 1.0 / z
    jx, jy = camera[12] * over_z, camera[13] * over_z
    d_u = -jx * (t0 * camera[6] + t1 * camera[7] + t2 * camera[8])
    d_v = -jy * (t3 * camera[6] + t4 * camera[7] + t5 * camera[8])
    d_u = through_clamp(x * over_z, camera[17], camera[18], d_u)
    d_v = through_clamp(y * over_z, camera[19], camera[20], d_v)
    d_z = total[conventions.D_DEPTH]
    d_z -= over_z * (t0 * j0 + t1 * j1 + t2 * j2 + t3 * j3 + t4 * j4 + t5 * j5)
    # the centre's own slopes, unclamped
    d_u += camera[12] * d_x2
    d_v += camera[13] * d_y2
    d_x = d_u * over_z
    d_y = d_v * over_z
    d_z -= (d_u * x + d_v * y) * over_z * over_z
    for c in range(3):
        out.means[i, c] = camera[c] * d_x + camera[3 + c] * d_y + camera[6 + c] * d_z
