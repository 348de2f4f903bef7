"""Bundler's ``.out`` file beside its photos, as Bundler, Metashape and RealityCapture write it.

Its manual, "Output format": P = R X + t, looking along -z with y up; p = -P / P.z; p' = f (1 + k1 p^2 + k2 p^4) p in
pixels from the picture's middle. Cameras have the order of the list of pictures; without a pose, f is 0."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import LARGEST_TABLE
from ...posed.frames import as_pose, inverse
from ...posed.image_header import read_image_header
from ...posed.layout import check_count, file_inside, natural_order, read_text, shown_files
from ..frame import Inferred, SparsePoints
from .capture import Capture, ListedCamera, Progress, SceneFormat, Shot, frame_names, shots_of
from .lens import Distortion, pinhole
from .photos import pictures_by_stem
from .poses import finite_pose, from_opengl

_FIX = "Export the Bundler file once more, with its list of pictures."
_TITLE = "# Bundle file"
_CAMERA, _POINT = 15, 6  # numbers of a camera, and of a point before its views
_LARGEST = 2.0**53  # beyond it, float64 holds no counts
_BY_ORDER = Inferred(
    "numbering", "cameras are paired with the photos by their order", "there is no list of pictures beside the .out"
)


def _file(place: Path) -> Path | None:
    files = [place] if place.is_file() else sorted(shown_files(place, "*.out"))
    return next((each for each in files if each.suffix.lower() == ".out" and each.is_file()), None)


def _read(place: Path, progress: Progress) -> Capture:
    path = _file(place)
    if path is None:
        raise PlgsError("no-bundler", "there is no .out file of Bundler", place, _FIX)
    text = read_text(path, LARGEST_TABLE, _FIX)
    title, _, rest = text.partition("\n")
    try:
        values = np.array(rest.split(), np.float64) if title.startswith(_TITLE) else np.zeros(0)
        cameras, points = (int(each) for each in values[:2])
    except (ValueError, OverflowError) as error:  # int() of infinity
        raise PlgsError("not-bundler", "this is not one of Bundler's files", path, _FIX) from error
    check_count(cameras, "cameras", path, _FIX, most=10**6, room=(len(values) - 2) // _CAMERA, made=500)
    named = _names(path, cameras)
    pictures, inferred = (named, tuple[Inferred, ...]()) if named is not None else _by_order(path, cameras)
    names = frame_names([str(each) for each in pictures])
    numbers = values[2 : 2 + _CAMERA * cameras].reshape(cameras, _CAMERA)
    listed_cameras: list[ListedCamera] = [
        (name, picture if picture.is_file() else None, partial(_shot, name, row, path) if row[0] > 0.0 else None)
        for name, picture, row in zip(names, pictures, numbers, strict=True)
    ]
    found, missing = shots_of(listed_cameras, path.parent, progress)
    sparse = _points(values[2 + _CAMERA * cameras :], points, names, path)
    return Capture(found, None, points=sparse, left_out=missing, inferred=inferred, has_unit=False)


def _names(path: Path, cameras: int) -> list[Path] | None:
    """Return the pictures in the list beside the file, whose lines begin with their names; None if there is no list."""
    folders = [path.parent, *sorted(each for each in shown_files(path.parent) if each.is_dir())]
    stem = path.name.removesuffix(".out")
    lists = [path.with_name(each) for each in (f"{stem}.list.txt", f"{stem}-list.txt", f"{stem}.txt", "list.txt")]
    for each in lists:
        lines = read_text(each, LARGEST_TABLE, _FIX).splitlines() if each.is_file() else []
        files = [_picture(line) for line in lines if line.strip()]
        if len(files) == cameras and cameras:
            return [_found(file, folders, path) for file in files]
    return None


def _picture(line: str) -> str:
    """Return the picture's path in a line of Bundler's list: ``images/0001.jpg`` of ``images/0001.jpg 0 1234.5``."""
    words = line.strip().split(" ")
    ends = [at for at, word in enumerate(words, 1) if word.lower().endswith((".jpg", ".jpeg", ".png"))]
    return " ".join(words[: ends[0]]) if ends else words[0]


def _found(file: str, folders: Sequence[Path], path: Path) -> Path:
    name = Path(file.replace("\\", "/")).name
    places = chain([file_inside(path.parent, file, path)] if not Path(file).is_absolute() else [],
                   (folder / name for folder in folders))  # fmt: skip
    return next((each for each in places if each.is_file()), path.parent / name)


def _by_order(path: Path, cameras: int) -> tuple[list[Path], tuple[Inferred, ...]]:
    photos = sorted({*pictures_by_stem(path.parent).values()}, key=lambda each: natural_order(each.name))
    if len(photos) != cameras:
        what = f"there are {cameras} cameras and {len(photos)} photos, and no list of pictures"
        raise PlgsError("no-list", what, path, "Put list.txt there, with a picture's name on each line.")
    return photos, (_BY_ORDER,)


def _shot(name: str, row: NDArray[np.float64], path: Path, picture: Path) -> Shot | None:
    width, height = read_image_header(picture).size
    lens = pinhole(width, height, row[0], row[0], width / 2.0, height / 2.0, path=path, fix=_FIX, whose=picture.name)
    pose = finite_pose(as_pose(row[3:12].reshape(3, 3), row[12:15]), path)
    distortion = Distortion((float(row[1]), float(row[2])))
    return None if pose is None else Shot(name, lens.at(from_opengl(inverse(pose))), picture, distortion=distortion)


def _points(values: NDArray[np.float64], count: int, names: Sequence[str], path: Path) -> SparsePoints | None:
    """Return the sparse points, and which of them each picture shows; None if ``count`` is 0. ``values`` are the file's
    numbers after the cameras. Raises PlgsError if they are no numbers, or end too early for ``count`` points."""
    check_count(count, "points", path, _FIX, most=10**7, room=len(values) // (_POINT + 1), made=200)
    if not (np.abs(values) < _LARGEST).all():  # False for NaN
        raise PlgsError("not-numbers", "a point has values that are no numbers", path, _FIX)
    rows, seen_by = np.empty((count, _POINT)), {name: list[int]() for name in names}
    at = 0
    for point in range(count):
        views = int(values[at + _POINT]) if at + _POINT < len(values) else -1
        if views < 0 or at + _POINT + 1 + 4 * views > len(values):
            raise PlgsError("cut-off", "the file is cut off", path, _FIX)
        rows[point] = values[at : at + _POINT]
        for camera in values[at + _POINT + 1 : at + _POINT + 1 + 4 * views : 4].astype(int):
            if 0 <= camera < len(names):
                seen_by[names[camera]].append(point)
        at += _POINT + 1 + 4 * views
    tracks = {name: np.array(found, np.int64) for name, found in seen_by.items()}
    return SparsePoints(rows[:, :3], rows[:, 3:].clip(0, 255).astype(np.uint8), tracks) if count else None


FORMAT = SceneFormat("bundler", lambda place: _file(place) is not None, _read)
