"""Stray Scanner: ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, ``depth/000000.png``, ``confidence/000000.png``.

A line of the odometry is a frame of the video: ``timestamp, frame, x, y, z, qx, qy, qz, qw``, camera-to-world, OpenCV
axes, metres, ARKit's world with y up; newer files add ``fx, fy, cx, cy`` for each. The matrix is for the video's
size. Depth is planar, in millimetres (older scans: .npy), 256x192; what the sensor trusts least is dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..depth import DepthReader, check_depth_header
from ..frame import SceneError, Size
from ..layout import files_by_stem
from ..matrices import placed, read_matrix
from .capture import Capture, Shot
from .confidence import ConfidentDepth
from .npy_depth import NpyDepthReader
from .poses import quaternion_pose
from .rows import numbers, read_rows
from .video import Video, VideoColour

LOOKS_FOR = "odometry.csv, camera_matrix.csv and rgb.mp4"
_COLUMNS = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_LENS = ("fx", "fy", "cx", "cy")
_FIX = "Copy the scan from the device again."


def recognises(place: Path) -> bool:
    return (place / "odometry.csv").is_file() and (place / "camera_matrix.csv").is_file()


def read(place: Path) -> Capture:
    """Open the frames; no picture is decoded. Raises SceneError."""
    video_path = place / "rgb.mp4"
    if not video_path.is_file():
        raise SceneError("the video is missing", video_path, _FIX)
    video = Video(video_path)
    size = video.size()
    matrix = read_matrix(place / "camera_matrix.csv", ((3, 3),))
    shared = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    depths = files_by_stem(place / "depth", {".png", ".npy"}, _FIX) if (place / "depth").is_dir() else {}
    levels = files_by_stem(place / "confidence", {".png"}, _FIX) if (place / "confidence").is_dir() else {}
    shots, lost = [], []
    for row in _read_odometry(place / "odometry.csv"):
        name = f"{int(row['frame']):06d}"
        values = [row[key] for key in _COLUMNS[1:]]
        if not np.isfinite(values).all():
            lost.append(name)
            continue
        x, y, z, qx, qy, qz, qw = values
        pose = quaternion_pose((qw, qx, qy, qz), (x, y, z), place / "odometry.csv")
        lens = _lens([row[key] for key in _LENS] if "fx" in row else shared, size, place)
        depth = depths.get(name)
        if depths and depth is None:
            raise SceneError(f"frame {name} has no depth", place / "depth", _FIX)
        reader = None if depth is None else _depth_reader(depth, levels.get(name), lens)
        colour = VideoColour(video, int(row["frame"]))
        shots.append(Shot(name, placed(lens, pose), video_path, colour, depth, reader, file_shows_colour=False))
    return Capture(tuple(shots), "y", tuple(lost), up_is_known=True)


def _read_odometry(path: Path) -> list[dict[str, float]]:
    """The rows by the names of their columns. Raises SceneError."""
    rows = read_rows(path, _FIX, ",", titles=True)
    head = next(rows, None)
    if head is None or not {*_COLUMNS} <= {*head.words}:
        raise SceneError(f"the first line does not name {', '.join(_COLUMNS)}", path, _FIX)
    found = []
    for row in rows:
        values = dict(zip(head.words, numbers(row, path, _FIX, len(head.words)).tolist(), strict=True))
        if not 0.0 <= values["frame"] < 1e9:
            raise SceneError(f"line {row.line} has no frame's number", path, _FIX)
        found.append(values)
    return found


def _lens(values: tuple[float, ...] | list[float], size: Size, place: Path) -> Camera:
    """A camera at the origin; the file does not say where pixels are counted from: their corners."""
    fx, fy, cx, cy = (float(value) for value in values)
    width, height = size
    if not (0.0 < fx < 1e6 and 0.0 < fy < 1e6 and 0.0 <= cx <= width and 0.0 <= cy <= height):
        raise SceneError(f"the intrinsics do not fit a video of {width}x{height}", place / "camera_matrix.csv", _FIX)
    return Camera(width, height, fx, fy, cx, cy, np.eye(4))


def _depth_reader(path: Path, level: Path | None, lens: Camera) -> Callable[[Size | None], NDArray[np.float32]]:
    if path.suffix.lower() == ".npy":
        reader: Callable[[Size | None], NDArray[np.float32]] = NpyDepthReader(path)
    else:
        check_depth_header(path, lens)
        reader = DepthReader(path)
    return reader if level is None else ConfidentDepth(reader, level)
