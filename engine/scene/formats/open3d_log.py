"""Folders as Open3D's reconstruction system has them: pictures, depth, and a trajectory.

* ``color``, ``image`` or ``rgb``, and ``depth`` (16-bit PNG, millimetres). As many of each belong together in the order
  of their names; where some have no depth, by their names.
* ``*.log`` in the folder or in ``scene``, of several the one with as many poses as there are pictures: for each
  picture a line of three numbers and a 4x4 camera-to-world; or ``trajectory.json``, Open3D's
  PinholeCameraTrajectory: world-to-camera, column by column, each with its lens.
* ``camera_intrinsic.json`` or another file that ``sensor_lens.py`` reads. Without it the lens is a PrimeSense's, 525
  525 319.5 239.5 of 640x480. OpenCV axes, metres, integer pixel centres.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import read_json_object, take_objects
from ...posed.camera import Camera
from ...posed.layout import files_by_stem
from ...posed.matrices import take_numbers
from ..depth import MILLIMETRES, png_depth
from .capture import Capture, SceneFormat, Shot, with_picture
from .lens import assumed
from .photos import LET_COLMAP
from .poses import finite_pose
from .rows import numbers, read_rows
from .sensor_lens import FILES, SensorLens, find_sensor_lens, open3d_lens

_COLOURS = ("color", "image", "rgb")
_IMAGES = {".jpg", ".jpeg", ".png"}
_FIX = "Write a line of three numbers and a 4x4 matrix, camera-to-world, for each picture."
_PRIMESENSE = Camera(640, 480, 525.0, 525.0, 320.0, 240.0, np.eye(4))
_GUESSED = assumed("a PrimeSense's", _PRIMESENSE, FILES[0])

_Poses = list[tuple[NDArray[np.float64], Camera | None]]
"""Camera-to-world, float64 [4, 4], of each picture, and the lens if the trajectory has it."""


def _recognises(place: Path) -> bool:
    has_pictures = any((place / name).is_dir() for name in _COLOURS) and (place / "depth").is_dir()
    return has_pictures and bool(_trajectories(place))


def _trajectories(place: Path) -> list[Path]:
    """The only .log; of several those that hold poses, trajectory.log first; without any a trajectory.json."""
    for folder in (place, place / "scene"):
        logs = sorted(folder.glob("*.log"), key=lambda path: (path.name != "trajectory.log", path.name))
        if len(logs) > 1:
            logs = [path for path in logs if _holds_poses(path)]
        if logs:
            return logs
        if (folder / "trajectory.json").is_file():
            return [folder / "trajectory.json"]
    return []


def _fitting(paths: list[Path], pictures: int) -> tuple[Path, _Poses]:
    """The only trajectory, or of several the first with as many poses as there are pictures. Raises PlgsError."""
    read = [(path, _read_json(path) if path.suffix == ".json" else _read_log(path)) for path in paths]
    fits = [(path, poses) for path, poses in read if len(poses) == pictures]
    if not fits and len(read) > 1:
        counts = ", ".join(f"{path.name} has {len(poses)}" for path, poses in read)
        what = f"no trajectory has as many poses as there are pictures, {pictures}: {counts}"
        raise PlgsError(what, paths[0].parent, "Keep the trajectory of these pictures.")
    return fits[0] if fits else read[0]


def _holds_poses(path: Path) -> bool:
    """Whether a file starts with three whole numbers and four numbers: other programs write logs of words there."""
    with path.open(encoding="utf-8", errors="replace") as file:
        start = [file.readline(200).split() for _ in range(2)]
    return [len(words) for words in start] == [3, 4] and all(word.lstrip("-").isdecimal() for word in start[0])


def _read(place: Path) -> Capture:
    """Open the frames; only headers of images are read. Raises PlgsError."""
    trajectories = _trajectories(place)
    if not trajectories:
        raise PlgsError("there is no trajectory", place, f"Add a .log file or trajectory.json, or {LET_COLMAP}.")
    folder = next((place / name for name in _COLOURS if (place / name).is_dir()), place / "color")
    colours = files_by_stem(folder, _IMAGES, "Put the pictures there.")
    depths = files_by_stem(place / "depth", {".png"}, "Put depth there, in millimetres.")
    trajectory, poses = _fitting(trajectories, len(colours))
    if len(depths) == len(colours):
        depths = dict(zip(colours, depths.values(), strict=True))
    if len(colours) != len(poses) or not {*depths} <= {*colours}:
        what = f"there are {len(colours)} pictures, {len(depths)} depth images and {len(poses)} poses"
        raise PlgsError(what, place, "Keep as many of each: they belong together in the order of their names.")
    sensor = find_sensor_lens(place)
    shared = sensor or SensorLens(place / FILES[0], _PRIMESENSE)
    is_guessed = sensor is None and poses[0][1] is None
    found: list[tuple[str, Shot | PlgsError | None]] = []
    for (name, colour), (matrix, own) in zip(colours.items(), poses, strict=True):
        pose = finite_pose(matrix, trajectory)
        shot: Shot | PlgsError | None = None
        if pose is not None:
            lens = shared if own is None else SensorLens(trajectory, own, step=shared.step)
            shot = with_picture(colour, partial(_shot, name, colour, depths.get(name), lens, pose))
        found.append((name, shot))
    inferred = (_GUESSED,) if is_guessed else shared.inferred if poses[0][1] is None else ()
    return Capture(found, None, shared.warnings, inferred=inferred)


def _shot(name: str, colour: Path, depth: Path | None, lens: SensorLens, pose: NDArray[np.float64]) -> Shot:
    camera = lens.fitting(colour)
    measured = None if depth is None else png_depth(depth, camera, lens.step or MILLIMETRES)
    return Shot(name, camera.at(pose), colour, measured, distortion=lens.distortion)


def _read_log(path: Path) -> _Poses:
    """Read five lines per pose. Raises PlgsError."""
    rows = list(read_rows(path, _FIX))
    if len(rows) % 5:
        raise PlgsError("the trajectory is cut off", path, _FIX)
    poses: _Poses = []
    for start in range(0, len(rows), 5):
        numbers(rows[start], path, _FIX, 3)
        poses.append((np.stack([numbers(row, path, _FIX, 4) for row in rows[start + 1 : start + 5]]), None))
    return poses


def _read_json(path: Path) -> _Poses:
    """Open3D's own trajectory. Raises PlgsError."""
    poses: _Poses = []
    for entry in take_objects(read_json_object(path), "parameters", "the file", path):
        matrix = take_numbers(entry, "extrinsic", "a pose", path, 16).reshape(4, 4).T
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
            raise PlgsError("an extrinsic matrix is not rigid", path, "Let Open3D write it again.")
        intrinsic = entry.get("intrinsic")
        poses.append((np.linalg.inv(matrix), open3d_lens(intrinsic, path) if isinstance(intrinsic, dict) else None))
    if not poses:
        raise PlgsError("the trajectory is empty", path, "Let Open3D write it again.")
    return poses


FORMAT = SceneFormat("open3d", _recognises, _read)
