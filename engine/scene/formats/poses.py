"""Poses as files have them: quaternions, OpenGL's axes, world-to-camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.matrices import rigid

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def finite_pose(matrix: NDArray[np.float64], path: Path) -> NDArray[np.float64] | None:
    """A camera-to-world pose, float64 [4, 4] or [3, 4], straightened; None when a number in it is not finite.

    Raises PlgsError when it is not rigid.
    """
    if not np.isfinite(matrix).all():
        return None
    pose = np.eye(4)
    pose[: len(matrix)] = matrix
    return rigid(pose, path)


def from_opengl(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """A pose, float64 [4, 4], of a camera with y up and z backward as one with y down and z forward."""
    return pose @ _FROM_OPENGL


def quaternion_pose(wxyz: Sequence[float], position: Sequence[float], path: Path) -> NDArray[np.float64]:
    """The pose, float64 [4, 4], that turns by a quaternion and then moves. Raises PlgsError for a zero quaternion."""
    w, x, y, z = (float(value) for value in wxyz)
    square = w * w + x * x + y * y + z * z
    if not square > 1e-12 or not np.isfinite(square):
        raise PlgsError("a quaternion is zero", path, "Write the rotation as a unit quaternion.")
    s = 2.0 / square
    pose = np.eye(4)
    pose[:3, :3] = [
        [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
    ]
    pose[:3, 3] = position
    return rigid(pose, path)


def inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of a rigid float64 [4, 4]."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result
