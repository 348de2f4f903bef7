"""Exports of phone apps that measure depth: Polycam, 3D Scanner App and Stray Scanner.

All poses are camera-to-world in metres, in ARKit's world with y up. Depth is planar, a 16-bit PNG in millimetres,
smaller than colour; pixels of the lowest confidence are dropped.

* Polycam's raw export: ``keyframes/`` with images, cameras, depth and confidence named by microseconds. A camera is a
  JSON file: ``t_00`` ... ``t_23``, the rows of the pose, OpenGL axes; ``fx fy cx cy width height``; corrected ones may
  lack the last two. Polycam's optimisation writes ``corrected_images`` and ``corrected_cameras``, undistorted and
  better; they are preferred, and keyframes without them are left out.
* 3D Scanner App's *All Data*: ``frame_00000.jpg``, ``frame_00000.json``, ``depth_00000.png``, ``conf_00000.png``. A
  JSON file holds ``cameraPoseARFrame``, 4x4 row by row, OpenGL axes; and ``intrinsics``, 3x3 row by row, in pixels of
  the picture. There is one for each depth map, but a picture for every few: only these are frames.
* Stray Scanner: ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, ``depth/000000.png`` (older scans: .npy),
  ``confidence/000000.png``. A line of the odometry describes a frame of the video: ``timestamp, frame, x, y, z, qx, qy,
  qz, qw``, OpenCV axes; newer files add ``fx, fy, cx, cy``. The matrix is for the video's size. The current app writes
  two more columns without values; only the columns read here need numbers."""

from __future__ import annotations

from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import PlgsError
from ...gates import open_plain
from ...job.progress import part_of
from ...json_file import read_json_object, take_number
from ...posed.image_header import read_image_header
from ...posed.layout import files_by_stem, listed, natural_order, of_most, shown_files
from ...posed.matrices import read_matrix, take_array
from ..depth import npy_depth, png_depth, trusted
from ..files_of_frames import IMAGES, files_if_any
from ..frame import Inferred
from .capture import Capture, Found, Progress, SceneFormat, Shot, watched, with_picture
from .lens import fitted, pinhole
from .photos import Video
from .poses import Row, finite_pose, from_opengl, numbers, quaternion_pose, read_rows

_POLYCAM_FIX = "Export the raw data from Polycam again."
_POLYCAM_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
_SIZE = ("width", "height")
_LENS = ("fx", "fy", "cx", "cy")
_NOT_OPTIMISED = "the poses were not optimised (no corrected_cameras): they are ARKit's own, and pictures are distorted"


def _read_polycam(place: Path, progress: Progress) -> Capture:
    folder = place / "keyframes"
    is_corrected = any(shown_files(folder, "corrected_cameras/*.json")) and (folder / "corrected_images").is_dir()
    prefix = "corrected_" if is_corrected else ""
    cameras = files_by_stem(folder / f"{prefix}cameras", {".json"}, _POLYCAM_FIX)
    images = files_by_stem(folder / f"{prefix}images", IMAGES, _POLYCAM_FIX)
    raw = {path.stem: path for path in shown_files(folder / "cameras", "*.json")} if is_corrected else cameras
    depths = files_if_any(folder / "depth", {".png"}, _POLYCAM_FIX)
    levels = files_if_any(folder / "confidence", {".png"}, _POLYCAM_FIX)
    with_both, half = [name for name in cameras if name in images], part_of(progress, 0.0, 0.5)
    entries = of_most(with_both, lambda name: read_json_object(cameras[name]), half)
    if not entries:
        raise PlgsError("no-camera", "no image has a camera", folder, _POLYCAM_FIX)
    found: dict[str, Found] = dict.fromkeys(sorted({*raw, *cameras, *images}, key=natural_order))
    for name, entry in watched([*entries.items()], part_of(progress, 0.5, 1.0)):
        size = _size(entry, images[name], cameras[name], raw.get(name))
        make = partial(_shot_polycam, name, entry, size, depth=depths.get(name), level=levels.get(name))
        found[name] = with_picture(images[name], partial(make, image=images[name], path=cameras[name]))
    warnings = [] if is_corrected else [_NOT_OPTIMISED]
    if len(entries) < len(found):
        lost = f"{len(found) - len(entries)} of {len(found)} keyframes"
        warnings.append(f"{lost} are not in both {prefix}cameras and {prefix}images, and are left out")
    sizeless = [name for name, entry in entries.items() if not _has_size(entry)]
    taken = f"the size of the pictures of {len(sizeless)} cameras, which do not say it, is inferred"
    reason = f"their principal points are nearest to its middle ({listed(sizeless)})"
    inferred = (Inferred("lens", taken, reason),) if sizeless else ()
    return Capture([*found.items()], "y", tuple(warnings), up_is_known=True, inferred=inferred)


def _has_size(entry: dict[str, Any]) -> bool:
    return all(key in entry for key in _SIZE)


def _size(entry: dict[str, Any], image: Path, path: Path, raw: Path | None) -> tuple[float, ...]:
    """Return the width and height that a camera's intrinsics refer to. If its ``entry`` does not say, take from the
    sizes of ``image`` and ``raw`` (the camera before optimisation) the one whose middle is nearer to the principal
    point."""
    if _has_size(entry):
        return tuple(take_number(entry, key, "the camera", path) for key in _SIZE)
    sizes: list[tuple[float, ...]] = [read_image_header(image).size]
    if raw is not None and _has_size(other := read_json_object(raw)):
        sizes.append(tuple(take_number(other, key, "the camera", raw) for key in _SIZE))
    middle = [take_number(entry, key, "the camera", path) for key in ("cx", "cy")]
    return min(sizes, key=lambda size: sum(abs(c - side / 2.0) for c, side in zip(middle, size, strict=True)))


def _shot_polycam(
    name: str, entry: dict[str, Any], size: tuple[float, ...], *, image: Path, path: Path, depth: Path | None,
    level: Path | None,
) -> Shot:  # fmt: skip
    values = [take_number(entry, key, "the camera", path) for key in _POLYCAM_POSE]
    pose = finite_pose(np.array(values).reshape(3, 4), path)
    assert pose is not None  # take_number takes finite numbers only
    lens = pinhole(*size, *(take_number(entry, key, "the camera", path) for key in _LENS), path=path, fix=_POLYCAM_FIX)
    lens = fitted(lens, image, _POLYCAM_FIX)
    depth_map = None if depth is None else trusted(png_depth(depth, lens), level)
    return Shot(name, lens.at(from_opengl(pose)), image, depth_map)


POLYCAM = SceneFormat("polycam", lambda place: (place / "keyframes").is_dir(), _read_polycam)


_SCANNER_APP_POSE, _SCANNER_APP_LENS = "cameraPoseARFrame", "intrinsics"
_SCANNER_APP_FIX = "Share the scan from the app again, as All Data."
_FIXED = np.array([[False, True, False], [True, False, False], [True, True, True]])
"""Elements of every camera's matrix that are 0 0 0 0 1."""
_LOOKED_AT = 4  # pictures whose JSON files are searched for a pose: other programs use the name frame_00000.json, too


def _recognises_scanner_app(place: Path) -> bool:
    tables = (path.with_suffix(".json") for path in shown_files(place, "frame_*.jpg"))
    for path in islice(filter(Path.is_file, tables), _LOOKED_AT):
        with open_plain(path) as file:
            if _SCANNER_APP_POSE.encode() in file.read(1 << 16):
                return True
    return False


def _read_scanner_app(place: Path, progress: Progress) -> Capture:
    pictures = _files(place, ".jpg", "frame_")
    tables = _files(place, ".json", "frame_")
    depths, levels = _files(place, ".png", "depth_"), _files(place, ".png", "conf_")
    found: list[tuple[str, Found]] = []
    for number, picture in watched([*pictures.items()], progress):
        table, depth, level = (files.get(number) for files in (tables, depths, levels))
        make = None if table is None else partial(_shot_scanner_app, picture, table, depth, level)
        found.append((picture.stem, with_picture(picture, make)))
    if not any(shot for _, shot in found):
        what = "no picture frame_<number>.jpg has its frame_<number>.json"
        raise PlgsError("no-pictures", what, place, _SCANNER_APP_FIX)
    return Capture(found, "y", up_is_known=True)


def _files(place: Path, suffix: str, kind: str) -> dict[str, Path]:
    """Return the files of one kind by the number in their names; there may be none."""
    if place.is_dir() and not any(shown_files(place, f"{kind}*{suffix}")):
        return {}
    files = files_by_stem(place, {suffix}, _SCANNER_APP_FIX)
    return {stem.removeprefix(kind): path for stem, path in files.items() if stem.startswith(kind)}


def _shot_scanner_app(picture: Path, table: Path, depth: Path | None, level: Path | None) -> Shot | None:
    entry = read_json_object(table)
    matrix = take_array(entry, _SCANNER_APP_POSE, "the frame", table, (16,)).reshape(4, 4)
    K = take_array(entry, _SCANNER_APP_LENS, "the frame", table, (9,)).reshape(3, 3)
    if not np.array_equal(K[_FIXED], [0.0, 0.0, 0.0, 0.0, 1.0]):
        what = f"{_SCANNER_APP_LENS} are not fx 0 cx, 0 fy cy, 0 0 1"
        raise PlgsError("not-camera-matrix", what, table, _SCANNER_APP_FIX)
    pose = finite_pose(matrix, table)
    if pose is None:
        return None
    width, height = read_image_header(picture).size
    lens = pinhole(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], path=table, fix=_SCANNER_APP_FIX)
    depth_map = None if depth is None else trusted(png_depth(depth, lens), level)
    return Shot(picture.stem, lens.at(from_opengl(pose)), picture, depth_map)


SCANNER_APP = SceneFormat("scanner-app", _recognises_scanner_app, _read_scanner_app)


_COLUMNS = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_STRAY_FIX = "Copy the scan from the device again."


def _read_stray(place: Path, progress: Progress) -> Capture:
    found = list[tuple[str, Shot | None]]()
    video = Video(place / "rgb.mp4")
    if not video.path.is_file():
        raise PlgsError("video-missing", "the video is missing", video.path, _STRAY_FIX)
    size = video.size()
    matrix = read_matrix(place / "camera_matrix.csv", ((3, 3),))
    shared = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    depths = files_if_any(place / "depth", {".png", ".npy"}, _STRAY_FIX)
    levels = files_if_any(place / "confidence", {".png"}, _STRAY_FIX)
    for row in watched(_read_odometry(place / "odometry.csv"), progress):
        name = f"{int(row['frame']):06d}"
        x, y, z, qx, qy, qz, qw = values = [row[key] for key in _COLUMNS[1:]]
        if not np.isfinite(values).all():
            found.append((name, None))
            continue
        pose = quaternion_pose((qw, qx, qy, qz), (x, y, z), place / "odometry.csv")  # the file has w last
        intrinsics = [row[key] for key in _LENS] if "fx" in row else shared
        lens = pinhole(*size, *intrinsics, path=place / "camera_matrix.csv", fix=_STRAY_FIX, whose=f"frame {name}")
        depth = None
        if name in depths:
            depth = npy_depth(depths[name]) if depths[name].suffix.lower() == ".npy" else png_depth(depths[name], lens)
            depth = trusted(depth, levels.get(name))
        found.append((name, Shot(name, lens.at(pose), video.path, depth, partial(video.frame, int(row["frame"])))))
    return Capture(found, "y", up_is_known=True, fps=video.fps())


def _read_odometry(path: Path) -> list[dict[str, float]]:
    """Read the odometry's rows, each by the names of its columns."""
    rows = read_rows(path, _STRAY_FIX, ",", titles=True)
    head = next(rows, None)
    if head is None or not {*_COLUMNS} <= {*head.words}:
        raise PlgsError("no-columns", f"the first line does not name {', '.join(_COLUMNS)}", path, _STRAY_FIX)
    found, wanted = [], {*_COLUMNS, *(_LENS if {*_LENS} <= {*head.words} else ())}
    for row in rows:
        if len(row.words) != len(head.words):
            what = f"line {row.line} holds {len(row.words)} numbers, not {len(head.words)}"
            raise PlgsError("wrong-count", what, path, _STRAY_FIX)
        given = {name: word for name, word in zip(head.words, row.words, strict=True) if name in wanted}
        if all(given[name] == "" for name in given.keys() & {*_LENS}):  # columns without values: the matrix holds
            given = {name: given[name] for name in _COLUMNS}
        values = dict(zip(given, numbers(Row(row.line, [*given.values()]), path, _STRAY_FIX).tolist(), strict=True))
        if not 0.0 <= values["frame"] < 1e9:
            raise PlgsError("no-frame-number", f"line {row.line} does not name a frame's number", path, _STRAY_FIX)
        found.append(values)
    return found


STRAY = SceneFormat(
    "stray", lambda place: (place / "odometry.csv").is_file() and (place / "camera_matrix.csv").is_file(), _read_stray
)
