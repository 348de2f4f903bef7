"""Matrices in text files and JSON, the poses and intrinsics that they hold, and which axis points up."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job.progress import Progress, part_of, unwatched
from ..json_file import take_list, wrong_type
from ..scene_source import UpAxis
from .frames import Camera, Size, as_pose
from .layout import of_most, read_text

Matrix = NDArray[np.float64]
_MOST_BYTES = 1 << 20
_RIGID_TOLERANCE = 2e-3
_NO_SKEW = 1e-3
_FARTHEST = 10_000.0  # metres from the origin; farther away, 32-bit floats no longer resolve millimetres


def read_matrix(path: Path, shapes: tuple[tuple[int, int], ...]) -> Matrix:
    """Read a matrix of one of ``shapes`` from text; it may hold inf, never NaN. Raises PlgsError for other text."""
    wanted = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    text = read_text(path, _MOST_BYTES, f"Write {wanted} numbers.").replace(",", " ")
    text = re.sub(r"1\.#INF0*", "inf", text)  # as programs of Visual C++ before 2015 wrote it
    lines = [words for line in text.splitlines() if (words := line.split())]
    if not lines:
        raise PlgsError("file-empty", "the file is empty", path, f"Write {wanted} numbers.")
    try:
        rows = [[float(value) for value in line] for line in lines]
    except ValueError as error:
        what = f"there is something other than numbers ({error})"
        raise PlgsError("not-numbers", what, path, f"Write {wanted} numbers.") from error
    if (len(rows), len(rows[0])) not in shapes or len({len(row) for row in rows}) > 1:
        raise PlgsError("not-matrix", f"the matrix is not {wanted}", path, f"Write {wanted} numbers, one row per line.")
    matrix = np.array(rows)
    if np.isnan(matrix).any():
        raise PlgsError("nan", "a number is NaN", path, "Write numbers that a camera can have.")
    return matrix


def take_array(entry: dict[str, Any], key: str, context: str, path: Path, *shapes: tuple[int, ...]) -> Matrix:
    """Return the JSON list ``entry[key]`` as an array of one of ``shapes``. Raises PlgsError for anything else; the
    error names the file ``path`` and the place ``context`` in it."""
    value = take_list(entry, key, context, path)
    try:
        numbers = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        numbers = np.empty(0)  # has none of the shapes
    if numbers.shape not in shapes:
        wanted = " or ".join("x".join(map(str, shape)) for shape in shapes)
        raise wrong_type(key, f"{wanted} numbers", value, context, path)
    return numbers


def read_poses(files: Mapping[str, Path], progress: Progress = unwatched) -> dict[str, NDArray[np.float64] | None]:
    """Read the camera-to-world pose, float64 [4, 4], in each frame's file. A pose is None if the file is missing, or
    holds no matrix or one with inf, which scanners write when tracking is lost. Raises PlgsError for a pose that is not
    rigid, and if most of the files that exist hold no pose."""
    there = [name for name, path in files.items() if path.is_file()]
    found = of_most(there, lambda name: read_matrix(files[name], ((4, 4),)), part_of(progress, 0.0, 0.5))
    lost = {name for name, pose in found.items() if np.isinf(pose).any()}
    kept, tick = found.keys() - lost, part_of(progress, 0.5, 1.0)
    poses: dict[str, NDArray[np.float64] | None] = {}
    for number, (name, path) in enumerate(files.items()):
        tick(number, len(files))
        poses[name] = rigid(found[name], path) if name in kept else None
    return poses


def rigid(pose: Matrix, path: Path) -> Matrix:
    """Return the camera-to-world pose, float64 [4, 4], that was read from ``path``, as an exactly rigid matrix: the
    rounding of its text is corrected. Raises PlgsError if it is not nearly rigid."""
    if not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0], atol=1e-4):
        what = "the last row of the pose is not 0 0 0 1"
        raise PlgsError("pose-last-row", what, path, "Write camera-to-world, one row per line.")
    rotation = pose[:3, :3]
    lengths = np.linalg.norm(rotation, axis=0)
    if lengths.min() > 1e-6 and np.abs(lengths / lengths.mean() - 1.0).max() < _RIGID_TOLERANCE:
        scale = float(lengths.mean())
        if abs(scale - 1.0) > _RIGID_TOLERANCE and _is_orthogonal(rotation / scale):
            what = f"the pose is scaled by {scale:.4g}"
            raise PlgsError("pose-scaled", what, path, "Divide its rotation by the scale; lengths are metres.")
    if not _is_orthogonal(rotation):
        what = "the pose is not rigid"
        raise PlgsError("not-rigid", what, path, "Write a rotation and a translation, camera-to-world.")
    if np.linalg.det(rotation) < 0.0:
        fix = "Use right-handed axes: x right, y down, z forward, camera-to-world."
        raise PlgsError("pose-mirrored", "the pose is mirrored", path, fix)
    far = float(np.abs(pose[:3, 3]).max())
    if far > _FARTHEST:
        what = f"the camera is {far:.4g} m from the origin, too far for exact positions"
        raise PlgsError("camera-far", what, path, "Write metres, and move the scene close to the origin.")
    left, _, right = np.linalg.svd(rotation)  # left @ right is the nearest rotation
    return as_pose(left @ right, pose[:3, 3])


def _is_orthogonal(rotation: Matrix) -> bool:
    return bool(np.abs(rotation.T @ rotation - np.eye(3)).max() < _RIGID_TOLERANCE)


def read_intrinsics(path: Path, size: Size) -> Camera:
    """Read the intrinsic matrix (3x3 or 4x4) for pictures of this ``size``. Raises PlgsError for a file without one."""
    return as_lens(read_matrix(path, ((3, 3), (4, 4), (3, 4))), size, path)


def as_lens(matrix: Matrix, size: Size, path: Path) -> Camera:
    """Return a camera at the origin from an intrinsic matrix whose pixel centres are integers (the camera's are at
    +0.5), for a picture of this ``size``. ``path`` is the matrix's file. Raises PlgsError for impossible numbers."""
    if not np.isfinite(matrix).all():
        raise PlgsError("inf", "a number is infinite", path, "Write the camera's fx, fy, cx and cy in pixels.")
    (fx, skew, cx), (row, fy, cy), last = matrix[0, :3], matrix[1, :3], matrix[2, :3]
    if fx <= 0.0 or fy <= 0.0 or not np.allclose(last, [0.0, 0.0, 1.0]):
        what = "this is not a camera matrix"
        raise PlgsError("not-camera-matrix", what, path, "Write fx 0 cx, 0 fy cy, 0 0 1, with fx and fy above 0.")
    if abs(skew) > _NO_SKEW * fx or abs(row) > _NO_SKEW * fy:
        raise PlgsError("skew", "the camera matrix has skew", path, "Rectify the images first.")
    width, height = size
    if not (0.0 <= cx + 0.5 <= width and 0.0 <= cy + 0.5 <= height):
        what = f"the principal point {cx:.4g}, {cy:.4g} lies outside the {width}x{height} images"
        raise PlgsError("principal-point", what, path, "Write the intrinsics in pixels of the colour images.")
    return Camera(width, height, float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5, np.eye(4))


TO_Z_UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
"""The rotation from a world with this axis up into one with z up."""
_CLEARLY_UP = 0.6
_NEARLY_UPRIGHT = 0.99  # cosine of 8 degrees: if z is this close to the cameras' up, z was meant to be up
_SPREAD = 0.3  # second over first singular value of the cameras' right axes; below it all cameras look the same way


def upright_turn(
    poses: Sequence[Matrix], asked: UpAxis, own: UpAxis | None, *, is_known: bool
) -> tuple[Matrix, list[str]]:
    """Return the rotation, float64 [3, 3], from a capture's world into one with z up, and warnings. ``poses`` are the
    cameras', float64 [4, 4] camera-to-world. ``asked`` is the up axis that the user chose, ``own`` the format's (None
    if unknown), and ``is_known`` says that ``own`` was measured."""
    axis: UpAxis | None = "z" if asked == "+z" else own if asked == "z" else asked
    if axis is None:
        return upright_rotation(poses), []
    turn = TO_Z_UP[axis]
    if is_known and axis == own:
        return turn, []
    tilted = up_axis_warning([turned(pose, turn) for pose in poses], axis)
    return turn, [tilted] if tilted else []


def turned(pose: Matrix, turn: Matrix) -> Matrix:
    """Return a camera-to-world pose, float64 [4, 4], in a world that is rotated by ``turn``, float64 [3, 3]."""
    return as_pose(turn @ pose[:3, :3], turn @ pose[:3, 3])


def up_axis_warning(poses: Sequence[Matrix], up: UpAxis) -> str | None:
    """Return a warning if cameras, float64 [4, 4] camera-to-world each, seem to stand upright about an axis other than
    z. This is judged by the mean of their up axes. Returns None if that is near z, or if no axis is clearly up."""
    mean = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    axis = int(np.abs(mean).argmax())
    if abs(mean[axis]) < _CLEARLY_UP or (axis == 2 and mean[2] > 0.0):
        return None
    written = TO_Z_UP[up].T @ mean
    axis = int(np.abs(written).argmax())
    name = ("-" if written[axis] < 0.0 else "") + "xyz"[axis]
    advice = f"lift with --up {name}" if name in TO_Z_UP else "turn the poses so that z points up"
    if mean[2] < -_CLEARLY_UP:
        advice = f"{advice}, or check that poses have y down and z forward (OpenGL's and Blender's are the reverse)"
    return f"the cameras' up is the axis {name}, not {up}, so boxes would be tilted: {advice}"


def upright_rotation(poses: Sequence[Matrix]) -> Matrix:
    """Return the rotation, float64 [3, 3], into a world in which cameras, float64 [4, 4] camera-to-world each, stand
    upright; the identity if z is nearly up. An upright camera's right axis is level, so "up" is perpendicular to all
    right axes. If all cameras look the same way, these leave the pitch open, and the cameras' mean up axis is used."""
    rights = np.array([pose[:3, 0] for pose in poses])
    mean_up = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    _, strengths, axes = np.linalg.svd(rights, full_matrices=True)
    spread = strengths[1] / strengths[0] if len(strengths) > 1 else 0.0
    up = axes[2] if spread > _SPREAD else mean_up  # right axes are level: the normal of their plane
    length = float(np.linalg.norm(up))
    if length < 1e-9:
        return np.eye(3)
    up = up / length * (-1.0 if up @ mean_up < 0.0 else 1.0)
    if up[2] > _NEARLY_UPRIGHT:
        return np.eye(3)
    return shortest_rotation(up, np.array([0.0, 0.0, 1.0]))


def shortest_rotation(one: Matrix, other: Matrix) -> Matrix:
    """Return the rotation by the smallest angle, float64 [3, 3], that takes the unit vector ``one`` to ``other``."""
    cosine = float(one @ other)
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])  # ``other`` is z in all calls
    x, y, z = np.cross(one, other)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
