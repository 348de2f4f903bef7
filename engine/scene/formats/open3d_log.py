"""Folders as Open3D's reconstruction system has them: pictures, depth, and a trajectory.

* ``color``, ``image`` or ``rgb``, and ``depth`` (16-bit PNG, millimetres), as many of each; they belong together in
  the order of their names.
* ``*.log`` in the folder or in ``scene``: for each picture a line of three numbers and a 4x4 camera-to-world; or
  ``trajectory.json``, Open3D's PinholeCameraTrajectory: world-to-camera, column by column, each with its lens.
* ``camera_intrinsic.json`` or ``intrinsic.json``, Open3D's PinholeCameraIntrinsic; without it the lens is a
  PrimeSense's, 525 525 319.5 239.5 of 640x480. OpenCV axes, metres, integer pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..colour import ColourReader
from ..depth import DepthReader, check_depth_header
from ..frame import SceneError
from ..image_header import read_image_header
from ..json_file import read_json_object, take_matrix, take_number, take_objects
from ..layout import files_by_stem, same_shape, shown_size
from ..matrices import placed
from .capture import Capture, Shot
from .poses import finite_pose
from .rows import numbers, read_rows

LOOKS_FOR = "a .log trajectory (or trajectory.json) with the folders depth and color, image or rgb"
_COLOURS = ("color", "image", "rgb")
_IMAGES = {".jpg", ".jpeg", ".png"}
_FIX = "Write a line of three numbers and a 4x4 matrix, camera-to-world, for each picture."
_PRIMESENSE = "the lens is taken for a PrimeSense's (525 525 319.5 239.5): write camera_intrinsic.json if it is not"


@dataclass(frozen=True, eq=False)
class _Pose:
    """Camera-to-world, float64 [4, 4], and the lens where the trajectory has it."""

    matrix: NDArray[np.float64]
    lens: Camera | None = None


def recognises(place: Path) -> bool:
    has_pictures = any((place / name).is_dir() for name in _COLOURS) and (place / "depth").is_dir()
    return has_pictures and _find_trajectory(place) is not None


def _find_trajectory(place: Path) -> Path | None:
    """The only .log there is, or a trajectory.json."""
    for folder in (place, place / "scene"):
        logs = sorted(folder.glob("*.log"))
        if len(logs) == 1:
            return logs[0]
        if (folder / "trajectory.json").is_file():
            return folder / "trajectory.json"
    return None


def read(place: Path) -> Capture:
    """Open the frames; only headers of images are read. Raises SceneError."""
    trajectory = _find_trajectory(place)
    if trajectory is None:
        raise SceneError("there is no trajectory, or more than one", place, "Keep one .log file or trajectory.json.")
    folder = next((place / name for name in _COLOURS if (place / name).is_dir()), place / "color")
    colours = files_by_stem(folder, _IMAGES, "Put the pictures there.")
    depths = files_by_stem(place / "depth", {".png"}, "Put depth there, in millimetres.")
    poses = _read_json(trajectory) if trajectory.suffix == ".json" else _read_log(trajectory)
    if not len(colours) == len(depths) == len(poses):
        what = f"there are {len(colours)} pictures, {len(depths)} depth images and {len(poses)} poses"
        raise SceneError(what, place, "Keep as many of each: they belong together in the order of their names.")
    shared, warnings = _shared_lens(place), []
    if shared is None and poses[0].lens is None:
        warnings.append(_PRIMESENSE)
        shared = Camera(640, 480, 525.0, 525.0, 320.0, 240.0, np.eye(4))
    shots, lost = [], []
    for (name, colour), depth, pose in zip(colours.items(), depths.values(), poses, strict=True):
        matrix = finite_pose(pose.matrix, trajectory)
        lens = pose.lens or shared
        if matrix is None or lens is None:
            lost.append(name)
            continue
        size = read_image_header(colour).size
        if not same_shape(size, (lens.width, lens.height)):
            what = f"the picture is {shown_size(size)}, its lens is for {shown_size((lens.width, lens.height))}"
            raise SceneError(what, colour, "Write the lens of these pictures into camera_intrinsic.json.")
        camera = placed(lens.resized(*size), matrix)
        check_depth_header(depth, camera)
        shots.append(Shot(name, camera, colour, ColourReader(colour), depth, DepthReader(depth)))
    return Capture(tuple(shots), None, tuple(lost), tuple(warnings))


def _read_log(path: Path) -> list[_Pose]:
    """Five lines a pose. Raises SceneError."""
    rows = list(read_rows(path, _FIX))
    if len(rows) % 5:
        raise SceneError("the trajectory is cut off", path, _FIX)
    poses = []
    for start in range(0, len(rows), 5):
        numbers(rows[start], path, _FIX, 3)
        poses.append(_Pose(np.stack([numbers(row, path, _FIX, 4) for row in rows[start + 1 : start + 5]])))
    return poses


def _read_json(path: Path) -> list[_Pose]:
    """Open3D's own trajectory. Raises SceneError."""
    poses = []
    for entry in take_objects(read_json_object(path), "parameters", "the file", path):
        extrinsic = {"extrinsic": [entry.get("extrinsic")]}
        matrix = take_matrix(extrinsic, "extrinsic", "a pose", path, ((1, 16),)).reshape(4, 4).T
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
            raise SceneError("an extrinsic matrix is not rigid", path, "Let Open3D write it again.")
        intrinsic = entry.get("intrinsic")
        lens = _lens(intrinsic, path) if isinstance(intrinsic, dict) else None
        poses.append(_Pose(np.linalg.inv(matrix), lens))
    if not poses:
        raise SceneError("the trajectory is empty", path, "Let Open3D write it again.")
    return poses


def _shared_lens(place: Path) -> Camera | None:
    for name in ("camera_intrinsic.json", "intrinsic.json"):
        if (place / name).is_file():
            return _lens(read_json_object(place / name), place / name)
    return None


def _lens(entry: dict[str, Any], path: Path) -> Camera:
    """A camera at the origin from Open3D's PinholeCameraIntrinsic. Raises SceneError."""
    width, height = (take_number(entry, key, "the intrinsics", path) for key in ("width", "height"))
    matrix = {"intrinsic_matrix": [entry.get("intrinsic_matrix")]}
    K = take_matrix(matrix, "intrinsic_matrix", "the intrinsics", path, ((1, 9),))[0].tolist()
    fx, fy, cx, cy = K[0], K[4], K[6] + 0.5, K[7] + 0.5
    if not (0.0 < fx < 1e6 and 0.0 < fy < 1e6 and 0.0 < cx < width < 2**16 and 0.0 < cy < height < 2**16):
        raise SceneError("the intrinsics are those of no camera", path, "Write width, height and intrinsic_matrix.")
    return Camera(round(width), round(height), fx, fy, cx, cy, np.eye(4))
