"""Poses and intrinsics: text files with one matrix each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..gates import read_plain
from .camera import Camera
from .frame import SceneError, Size

_MOST_BYTES = 1 << 20
UpAxis = Literal["z", "y", "-y"]

_TO_Z_UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
_RIGID_TOLERANCE = 2e-3
_NO_SKEW = 1e-3
_CLEARLY_UP = 0.6
_FARTHEST = 10_000.0
"""Metres: positions are 32-bit floats, which tell millimetres apart up to here."""


def read_matrix(path: Path, shapes: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """Read a matrix of one of ``shapes`` from text; it may hold inf, never NaN. Raises SceneError."""
    wanted = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    try:
        lines = [line.replace(",", " ").split() for line in read_plain(path, _MOST_BYTES).decode().splitlines()]
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    except UnicodeDecodeError as error:
        raise SceneError("this is not a text file", path, f"Write {wanted} numbers.") from error
    lines = [line for line in lines if line]
    if not lines:
        raise SceneError("the file is empty", path, f"Write {wanted} numbers.")
    try:
        rows = [[float(value) for value in line] for line in lines]
    except ValueError as error:
        raise SceneError(f"there is something else than numbers ({error})", path, f"Write {wanted} numbers.") from error
    if (len(rows), len(rows[0])) not in shapes or len({len(row) for row in rows}) > 1:
        raise SceneError(f"the matrix is not {wanted}", path, f"Write {wanted} numbers, a row a line.")
    matrix = np.array(rows)
    if np.isnan(matrix).any():
        raise SceneError("there is a NaN", path, "Write numbers that a camera can have.")
    return matrix


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """Read a camera-to-world pose, float64 [4, 4].

    None when it holds inf, which is how scanners say that tracking was lost. Raises SceneError as ``rigid`` does.
    """
    pose = read_matrix(path, ((4, 4),))
    return None if np.isinf(pose).any() else rigid(pose, path)


def rigid(pose: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """A camera-to-world pose, float64 [4, 4], that the file ``path`` holds.

    Raises SceneError for a matrix that is not rigid. What text rounding has bent is straightened, so that the inverse
    is exact.
    """
    if not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0], atol=1e-4):
        raise SceneError("the last row of the pose is not 0 0 0 1", path, "Write camera-to-world, rows as lines.")
    rotation = pose[:3, :3]
    lengths = np.linalg.norm(rotation, axis=0)
    if lengths.min() > 1e-6 and np.abs(lengths / lengths.mean() - 1.0).max() < _RIGID_TOLERANCE:
        scale = float(lengths.mean())
        if abs(scale - 1.0) > _RIGID_TOLERANCE and _is_orthogonal(rotation / scale):
            raise SceneError(
                f"the pose is scaled by {scale:.4g}", path, "Divide its rotation by the scale; lengths are metres."
            )
    if not _is_orthogonal(rotation):
        raise SceneError("the pose is not rigid", path, "Write a rotation and a translation, camera-to-world.")
    if np.linalg.det(rotation) < 0.0:
        raise SceneError(
            "the pose is mirrored", path, "Use right-handed axes: x right, y down, z forward, camera-to-world."
        )
    far = float(np.abs(pose[:3, 3]).max())
    if far > _FARTHEST:
        raise SceneError(
            f"the camera is {far:.4g} m from the origin, too far for exact positions",
            path,
            "Write metres, and move the scene close to the origin.",
        )
    left, _, right = np.linalg.svd(rotation)
    straight = np.eye(4)
    straight[:3, :3] = left @ right
    straight[:3, 3] = pose[:3, 3]
    return straight


def to_z_up(up: UpAxis) -> NDArray[np.float64]:
    """The rotation, float64 [3, 3], of a world whose axis ``up`` points up into one whose z does."""
    return _TO_Z_UP[up]


def turned(pose: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """A camera-to-world pose, float64 [4, 4], in the world that the rotation ``turn``, float64 [3, 3], makes."""
    result = np.eye(4)
    result[:3, :3] = turn @ pose[:3, :3]
    result[:3, 3] = turn @ pose[:3, 3]
    return result


def up_axis_warning(poses: Sequence[NDArray[np.float64]], up: UpAxis) -> str | None:
    """A warning when cameras, float64 [4, 4] camera-to-world each, are upright about another axis than z, else None.

    People hold cameras upright: the mean of their own up axes is close to the world's, unless all of them look steeply
    up or down or lie on their side, and then nothing is said.
    """
    mean = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    axis = int(np.abs(mean).argmax())
    if abs(mean[axis]) < _CLEARLY_UP or (axis == 2 and mean[2] > 0.0):
        return None
    written = _TO_Z_UP[up].T @ mean
    axis = int(np.abs(written).argmax())
    name = ("-" if written[axis] < 0.0 else "") + "xyz"[axis]
    advice = f"lift with --up {name}" if name in _TO_Z_UP else "turn the poses so that z points up"
    if mean[2] < -_CLEARLY_UP:
        advice = f"{advice}, or see that poses have y down and z forward (OpenGL's and Blender's are the reverse)"
    return f"the cameras' up is the axis {name}, not {up}, so boxes would be tilted: {advice}"


def _is_orthogonal(rotation: NDArray[np.float64]) -> bool:
    return bool(np.abs(rotation.T @ rotation - np.eye(3)).max() < _RIGID_TOLERANCE)


def read_intrinsics(path: Path, size: Size) -> Camera:
    """Read K (3x3 or 4x4, integer pixel centres) of a ``size`` picture: a camera at the origin, centres at +0.5.

    Raises SceneError for numbers that no camera has.
    """
    matrix = read_matrix(path, ((3, 3), (4, 4), (3, 4)))
    if np.isinf(matrix).any():
        raise SceneError("there is an inf", path, "Write the camera's fx, fy, cx and cy in pixels.")
    (fx, skew, cx), (row, fy, cy), last = matrix[0, :3], matrix[1, :3], matrix[2, :3]
    if fx <= 0.0 or fy <= 0.0 or not np.allclose(last, [0.0, 0.0, 1.0]):
        raise SceneError("this is no camera matrix", path, "Write fx 0 cx, 0 fy cy, 0 0 1, with fx and fy above 0.")
    if abs(skew) > _NO_SKEW * fx or abs(row) > _NO_SKEW * fy:
        raise SceneError("the camera matrix has skew", path, "Rectify the images first.")
    width, height = size
    if not (0.0 <= cx + 0.5 <= width and 0.0 <= cy + 0.5 <= height):
        raise SceneError(
            f"the principal point {cx:.4g}, {cy:.4g} lies outside the {width}x{height} images",
            path,
            "Write the intrinsics in pixels of the colour images.",
        )
    return Camera(width, height, float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5, np.eye(4))


def placed(camera: Camera, pose: NDArray[np.float64]) -> Camera:
    """The same lens at another pose, float64 [4, 4] camera-to-world."""
    return Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose)
