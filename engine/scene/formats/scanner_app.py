"""3D Scanner App's *All Data*: ``frame_00000.jpg``, ``frame_00000.json``, ``depth_00000.png``, ``conf_00000.png``.

A JSON file holds ``cameraPoseARFrame``, 4x4 row by row: camera-to-world, OpenGL axes, metres, ARKit's world with y up;
and ``intrinsics``, 3x3 row by row, in pixels of the picture. There is one for each depth map; the app keeps a picture
for every few of them, and only these are frames. Depth is a 16-bit PNG in millimetres, smaller than colour; pixels of
the lowest confidence are dropped.
"""

from __future__ import annotations

from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from ...errors import PlgsError
from ...gates import open_plain
from ...json_file import read_json_object
from ...posed.image_header import read_image_header
from ...posed.layout import files_by_stem
from ...posed.matrices import take_numbers
from ..depth import png_depth, trusted
from .capture import Capture, SceneFormat, Shot, with_picture
from .lens import pinhole
from .poses import finite_pose, from_opengl

_POSE, _LENS = "cameraPoseARFrame", "intrinsics"
_FIX = "Share the scan from the app again, as All Data."
_FIXED = np.array([[False, True, False], [True, False, False], [True, True, True]])
"""Elements of every camera's matrix that are 0 0 0 0 1."""
_LOOKED_AT = 4
"""Pictures whose JSON files are searched for a pose: other programs name theirs frame_00000.json, too."""


def _recognises(place: Path) -> bool:
    tables = (path.with_suffix(".json") for path in place.glob("frame_*.jpg"))
    return any(_has_pose(path) for path in islice(filter(Path.is_file, tables), _LOOKED_AT))


def _has_pose(path: Path) -> bool:
    with open_plain(path) as file:
        return _POSE.encode() in file.read(1 << 16)


def _read(place: Path) -> Capture:
    """Open the pictures; only their headers are read. Raises PlgsError."""
    pictures = _files(place, ".jpg", "frame_")
    tables = _files(place, ".json", "frame_")
    depths, levels = _files(place, ".png", "depth_"), _files(place, ".png", "conf_")
    found: list[tuple[str, Shot | PlgsError | None]] = []
    for number, picture in pictures.items():
        table, depth, level = (files.get(number) for files in (tables, depths, levels))
        make = None if table is None else partial(_shot, picture, table, depth, level)
        found.append((picture.stem, None if make is None else with_picture(picture, make)))
    if not any(shot for _, shot in found):
        raise PlgsError("no picture frame_<number>.jpg has its frame_<number>.json", place, _FIX)
    return Capture(found, "y", up_is_known=True)


def _files(place: Path, suffix: str, kind: str) -> dict[str, Path]:
    """Files of one kind by the number in their names; there may be none. Raises PlgsError."""
    if place.is_dir() and not any(place.glob(f"{kind}*{suffix}")):
        return {}
    files = files_by_stem(place, {suffix}, _FIX)
    return {stem.removeprefix(kind): path for stem, path in files.items() if stem.startswith(kind)}


def _shot(picture: Path, table: Path, depth: Path | None, level: Path | None) -> Shot | None:
    """None where the pose is not finite. Raises PlgsError."""
    entry = read_json_object(table)
    matrix = take_numbers(entry, _POSE, "the frame", table, 16).reshape(4, 4)
    K = take_numbers(entry, _LENS, "the frame", table, 9).reshape(3, 3)
    if not np.array_equal(K[_FIXED], [0.0, 0.0, 0.0, 0.0, 1.0]):
        raise PlgsError(f"{_LENS} are not fx 0 cx, 0 fy cy, 0 0 1", table, _FIX)
    pose = finite_pose(matrix, table)
    if pose is None:
        return None
    width, height = read_image_header(picture).size
    lens = pinhole(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], path=table, fix=_FIX)
    depth_map = None if depth is None else trusted(png_depth(depth, lens), level)
    return Shot(picture.stem, lens.at(from_opengl(pose)), picture, depth_map)


FORMAT = SceneFormat("scanner-app", _recognises, _read)
