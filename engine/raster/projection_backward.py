"""From a Gaussian's gradients on the image back to those of its 3D parameters, in double."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..machine.compiled import Array, device_function
from .arrays import GaussianGradients, Shapes
from .conventions import (
    D_DEPTH,
    G_S1,
    G_S1S1,
    G_S1S2,
    G_S2,
    G_S2S2,
    L11,
    L11_LOW,
    L12,
    L12_LOW,
    L22,
    L22_LOW,
    WHITENING,
)
from .projection import LOG2_E, axes_on_image, camera_point, image_jacobian, quaternion_of, rotation_of, three_of


@device_function
def gradient_on_image(record: Array, total: Array) -> Any:
    """dL/d(centre x, y) and dL/d(covariance xx, xy = yx, yy) from the moments of the whitened offsets.

    With A = WHITENING * L, s = A d and g = dL/d(ln alpha): ln alpha = -|s|^2 / log2(e), so
    dL/dcentre = 2 / log2(e) * A^T sum(g s) and dL/dcov = A^T sum(g s s^T) A / (log2(e) * WHITENING^2).
    """
    a = np.float64(record[L11]) + np.float64(record[L11_LOW])
    b = np.float64(record[L12]) + np.float64(record[L12_LOW])
    c = np.float64(record[L22]) + np.float64(record[L22_LOW])
    s1, s2, s11, s12, s22 = total[G_S1], total[G_S2], total[G_S1S1], total[G_S1S2], total[G_S2S2]
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
    """Apply the chain rule to ``project_gaussian``: from the gradients ``total`` [GRADIENT] of Gaussian i, summed over
    its tiles, to those of its mean, scales, quaternion and 2D mean."""
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
    along = d_w * w + d_qx * qx + d_qy * qy + d_qz * qz
    out.quats[i, 0] = (d_w - along * w) * over_norm
    out.quats[i, 1] = (d_qx - along * qx) * over_norm
    out.quats[i, 2] = (d_qy - along * qy) * over_norm
    out.quats[i, 3] = (d_qz - along * qz) * over_norm

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
    d_z = total[D_DEPTH]
    d_z -= over_z * (t0 * j0 + t1 * j1 + t2 * j2 + t3 * j3 + t4 * j4 + t5 * j5)
    # the centre's own slopes, unclamped
    d_u += camera[12] * d_x2
    d_v += camera[13] * d_y2
    d_x = d_u * over_z
    d_y = d_v * over_z
    d_z -= (d_u * x + d_v * y) * over_z * over_z
    for c in range(3):
        out.means[i, c] = camera[c] * d_x + camera[3 + c] * d_y + camera[6 + c] * d_z
