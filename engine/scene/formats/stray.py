"""Stray Scanner: ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, ``depth/000000.png``, ``confidence/000000.png``.

A line of the odometry is a frame of the video: ``timestamp, frame, x, y, z, qx, qy, qz, qw``, camera-to-world, OpenCV
axes, metres, ARKit's world with y up; newer files add ``fx, fy, cx, cy`` for each. The matrix is for the video's
size. Today's app writes two more columns, whose values are empty; only columns that are read need a number. Depth is
planar, in millimetres (older scans: .npy), 256x192; pixels of the lowest confidence are dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...errors import PlgsError
from ...posed.matrices import read_matrix
from ..depth import npy_depth, png_depth, trusted
from ..files_of_frames import files_if_any
from .capture import Capture, SceneFormat, Shot
from .lens import pinhole
from .photos import Video
from .poses import Row, numbers, quaternion_pose, read_rows

_COLUMNS = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_LENS = ("fx", "fy", "cx", "cy")
_FIX = "Copy the scan from the device again."


def _recognises(place: Path) -> bool:
    return (place / "odometry.csv").is_file() and (place / "camera_matrix.csv").is_file()


def _read(place: Path) -> Capture:
    """Open the frames; no picture is decoded. Raises PlgsError."""
    return Capture(list(_shots(place)), "y", up_is_known=True)


def _shots(place: Path) -> Iterator[tuple[str, Shot | None]]:
    video = Video(place / "rgb.mp4")
    if not video.path.is_file():
        raise PlgsError("the video is missing", video.path, _FIX)
    size = video.size()
    matrix = read_matrix(place / "camera_matrix.csv", ((3, 3),))
    shared = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    depths = files_if_any(place / "depth", {".png", ".npy"}, _FIX)
    levels = files_if_any(place / "confidence", {".png"}, _FIX)
    for row in _read_odometry(place / "odometry.csv"):
        name = f"{int(row['frame']):06d}"
        x, y, z, qx, qy, qz, qw = values = [row[key] for key in _COLUMNS[1:]]
        if not np.isfinite(values).all():
            yield name, None
            continue
        pose = quaternion_pose((qw, qx, qy, qz), (x, y, z), place / "odometry.csv")
        intrinsics = [row[key] for key in _LENS] if "fx" in row else shared
        lens = pinhole(*size, *intrinsics, path=place / "camera_matrix.csv", fix=_FIX, whose=f"frame {name}")
        depth = None
        if name in depths:
            depth = npy_depth(depths[name]) if depths[name].suffix.lower() == ".npy" else png_depth(depths[name], lens)
            depth = trusted(depth, levels.get(name))
        yield name, Shot(name, lens.at(pose), video.path, depth, video.reader(int(row["frame"])))


def _read_odometry(path: Path) -> list[dict[str, float]]:
    """The rows by the names of their columns. Raises PlgsError."""
    rows = read_rows(path, _FIX, ",", titles=True)
    head = next(rows, None)
    if head is None or not {*_COLUMNS} <= {*head.words}:
        raise PlgsError(f"the first line does not name {', '.join(_COLUMNS)}", path, _FIX)
    found, wanted = [], {*_COLUMNS, *(_LENS if {*_LENS} <= {*head.words} else ())}
    for row in rows:
        if len(row.words) != len(head.words):
            raise PlgsError(f"line {row.line} holds {len(row.words)} numbers, not {len(head.words)}", path, _FIX)
        given = {name: word for name, word in zip(head.words, row.words, strict=True) if name in wanted}
        if all(given[name] == "" for name in given.keys() & {*_LENS}):
            given = {name: given[name] for name in _COLUMNS}
        values = dict(zip(given, numbers(Row(row.line, [*given.values()]), path, _FIX).tolist(), strict=True))
        if not 0.0 <= values["frame"] < 1e9:
            raise PlgsError(f"line {row.line} does not name a frame's number", path, _FIX)
        found.append(values)
    return found


FORMAT = SceneFormat("stray", _recognises, _read)
