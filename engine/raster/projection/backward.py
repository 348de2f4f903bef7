"""From a Gaussian's gradients on the image back to those of its 3D parameters, sixteen Gaussians side by side."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function
from ..arrays import GaussianGradients, Gaussians
from ..records import (
    D_DEPTH,
    G_S1,
    G_S1S1,
    G_S1S2,
    G_S2,
    G_S2S2,
    GRADIENT,
    L11,
    L11_LOW,
    L12,
    L12_LOW,
    L22,
    L22_LOW,
    WHITENING,
)
from .forward import LOG2_E, axes_on_image, camera_point, image_jacobian, rotation_of, unit_quaternion
from .lanes import LANES, MEAN, OTHERS, SCALE, WHO, load_lane, quaternion_in, three_of

# the other rows of a block, from which place on
WHITENED = OTHERS  # L11, L12, L22
TOTAL = WHITENED + 3 * LANES  # as summed over tiles: GRADIENT rows
D_MEAN = TOTAL + GRADIENT * LANES
D_SCALE, D_QUAT, D_CENTRE = D_MEAN + 3 * LANES, D_MEAN + 6 * LANES, D_MEAN + 10 * LANES
GRADIENT_BLOCK = D_MEAN + 12 * LANES
"""Doubles of a block."""


@device_function
def load_gradient_lane(i: int, lane: int, total: Array, records: Array, gaussians: Gaussians, block: Array) -> None:
    """Gaussian i takes a lane, with its summed tile gradients [GRADIENT] (double)."""
    load_lane(i, lane, gaussians, block)
    block[WHITENED + lane] = np.float64(records[i, L11]) + np.float64(records[i, L11_LOW])
    block[WHITENED + LANES + lane] = np.float64(records[i, L12]) + np.float64(records[i, L12_LOW])
    block[WHITENED + 2 * LANES + lane] = np.float64(records[i, L22]) + np.float64(records[i, L22_LOW])
    for c in range(GRADIENT):
        block[TOTAL + c * LANES + lane] = total[c]


@device_function
def store_gradient_lanes(lanes: int, block: Array, out: GaussianGradients) -> None:
    """The gradients of so many Gaussians go to their places."""
    for lane in range(lanes):
        i = int(block[WHO + lane])
        for c in range(3):
            out.means[i, c] = block[D_MEAN + c * LANES + lane]
            out.scales[i, c] = block[D_SCALE + c * LANES + lane]
        for c in range(4):
            out.quats[i, c] = block[D_QUAT + c * LANES + lane]
        for c in range(2):
            out.means2d[i, c] = block[D_CENTRE + c * LANES + lane]


@device_function
def gradient_on_image(lane: int, block: Array) -> Any:
    """dL/d(centre x, y) and dL/d(covariance xx, xy = yx, yy) from the moments of the whitened offsets.

    With A = WHITENING * L, s = A d and g = dL/d(ln alpha): ln alpha = -|s|^2 / log2(e), so
    dL/dcentre = 2 / log2(e) * A^T sum(g s) and dL/dcov = A^T sum(g s s^T) A / (log2(e) * WHITENING^2).
    """
    a, b, c = three_of(WHITENED, lane, block)
    s1, s2 = block[TOTAL + G_S1 * LANES + lane], block[TOTAL + G_S2 * LANES + lane]
    s11, s12 = block[TOTAL + G_S1S1 * LANES + lane], block[TOTAL + G_S1S2 * LANES + lane]
    s22 = block[TOTAL + G_S2S2 * LANES + lane]
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
def project_block_backward(camera: Array, block: Array) -> None:
    """The chain rule of ``project_block`` for all lanes of a block; lanes that hold no Gaussian may hold anything."""
    for lane in range(LANES):
        d_x2, d_y2, d_xx, d_xy, d_yy = gradient_on_image(lane, block)
        block[D_CENTRE + lane] = d_x2
        block[D_CENTRE + LANES + lane] = d_y2
        mean_x, mean_y, mean_z = three_of(MEAN, lane, block)
        x, y, z = camera_point(camera, mean_x, mean_y, mean_z)
        jacobian = image_jacobian(camera, x, y, z)
        j0, j1, j2, j3, j4, j5, u, v = jacobian
        w, qx, qy, qz, over_norm = unit_quaternion(*quaternion_in(lane, block))
        rotation = rotation_of(w, qx, qy, qz)
        q0, q1, q2, q3, q4, q5, q6, q7, q8 = rotation
        sx, sy, sz = three_of(SCALE, lane, block)
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
        block[D_SCALE + lane] = m0 * q0 + m3 * q3 + m6 * q6
        block[D_SCALE + LANES + lane] = m1 * q1 + m4 * q4 + m7 * q7
        block[D_SCALE + 2 * LANES + lane] = m2 * q2 + m5 * q5 + m8 * q8
        m0, m3, m6 = m0 * sx, m3 * sx, m6 * sx
        m1, m4, m7 = m1 * sy, m4 * sy, m7 * sy
        m2, m5, m8 = m2 * sz, m5 * sz, m8 * sz
        d_w = 2.0 * (qx * (m7 - m5) + qy * (m2 - m6) + qz * (m3 - m1))
        d_qx = 2.0 * (qy * (m1 + m3) + qz * (m2 + m6) - 2.0 * qx * (m4 + m8) + w * (m7 - m5))
        d_qy = 2.0 * (qx * (m1 + m3) + qz * (m5 + m7) - 2.0 * qy * (m0 + m8) + w * (m2 - m6))
        d_qz = 2.0 * (qx * (m2 + m6) + qy * (m5 + m7) - 2.0 * qz * (m0 + m4) + w * (m3 - m1))
        along = d_w * w + d_qx * qx + d_qy * qy + d_qz * qz
        block[D_QUAT + lane] = (d_w - along * w) * over_norm
        block[D_QUAT + LANES + lane] = (d_qx - along * qx) * over_norm
        block[D_QUAT + 2 * LANES + lane] = (d_qy - along * qy) * over_norm
        block[D_QUAT + 3 * LANES + lane] = (d_qz - along * qz) * over_norm

        # dT = dX M^T
        c0, c1, c2 = q0 * sx, q1 * sy, q2 * sz
        c3, c4, c5 = q3 * sx, q4 * sy, q5 * sz
        c6, c7, c8 = q6 * sx, q7 * sy, q8 * sz
        t0, t1, t2 = (
            da0 * c0 + da1 * c1 + da2 * c2,
            da0 * c3 + da1 * c4 + da2 * c5,
            da0 * c6 + da1 * c7 + da2 * c8,
        )
        t3, t4, t5 = (
            db0 * c0 + db1 * c1 + db2 * c2,
            db0 * c3 + db1 * c4 + db2 * c5,
            db0 * c6 + db1 * c7 + db2 * c8,
        )
        # T = [fx/z (R0 - u R2); fy/z (R1 - v R2)] with the clamped slopes u = x/z, v = y/z
        over_z = 1.0 / z
        jx, jy = camera[12] * over_z, camera[13] * over_z
        d_u = -jx * (t0 * camera[6] + t1 * camera[7] + t2 * camera[8])
        d_v = -jy * (t3 * camera[6] + t4 * camera[7] + t5 * camera[8])
        d_u = through_clamp(x * over_z, camera[17], camera[18], d_u)
        d_v = through_clamp(y * over_z, camera[19], camera[20], d_v)
        d_z = block[TOTAL + D_DEPTH * LANES + lane]
        d_z -= over_z * (t0 * j0 + t1 * j1 + t2 * j2 + t3 * j3 + t4 * j4 + t5 * j5)
        # the centre's own slopes, unclamped
        d_u += camera[12] * d_x2
        d_v += camera[13] * d_y2
        d_x = d_u * over_z
        d_y = d_v * over_z
        d_z -= (d_u * x + d_v * y) * over_z * over_z
        block[D_MEAN + lane] = camera[0] * d_x + camera[3] * d_y + camera[6] * d_z
        block[D_MEAN + LANES + lane] = camera[1] * d_x + camera[4] * d_y + camera[7] * d_z
        block[D_MEAN + 2 * LANES + lane] = camera[2] * d_x + camera[5] * d_y + camera[8] * d_z
