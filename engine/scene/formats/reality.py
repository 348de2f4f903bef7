"""RealityScan's and RealityCapture's *Internal/External camera parameters* (CSV) beside their photos.

A row a photo: ``#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``. Angles are degrees; z is up. The focal
length is that of a film 36 mm wide, and the principal point counts from the middle, in parts of the longer side ("XMP
Camera Math" of its support; nerfstudio and Brush read it so). The distortion is Brown's, as OpenCV's; k4 is of r^8."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import open_plain
from ...json_file import LARGEST_TABLE
from ...posed.frames import as_pose
from ...posed.image_header import read_image_header
from ...posed.layout import read_text, shown_files
from .capture import Capture, ListedCamera, Progress, SceneFormat, Shot, shots_of
from .lens import Distortion, pinhole
from .photos import picture_of, pictures_by_stem
from .poses import finite_pose, from_opengl

_NEEDED = ("x", "y", "alt", "heading", "pitch", "roll", "f")
_FILM = 36.0  # millimetres, the width of the film that focal lengths are for
_FIX = "Export Registration > Internal/External camera parameters once more."


def _titles(line: str) -> list[str]:
    return [each.strip().removeprefix("#").lower() for each in line.split(",")]


def _file(place: Path) -> Path | None:
    """Return the table, recognised by its titles: ``place`` itself, or the first in that folder; None without one."""
    for path in [place] if place.is_file() else sorted(shown_files(place, "*.csv")):
        try:
            with open_plain(path) as file:
                titles = _titles(file.readline(4096).decode("utf-8-sig", "replace"))
        except OSError:
            continue
        if path.suffix.lower() == ".csv" and {"name", *_NEEDED} <= {*titles}:
            return path
    return None


def _read(place: Path, progress: Progress) -> Capture:
    path = _file(place)
    if path is None:
        raise PlgsError("no-reality", "there is no CSV of internal and external camera parameters", place, _FIX)
    lines = read_text(path, LARGEST_TABLE, _FIX).removeprefix("\ufeff").splitlines()
    try:
        rows = [row for row in csv.DictReader(lines[1:], _titles(lines[0])) if row["name"]]
    except csv.Error as error:
        raise PlgsError("not-csv", f"the table is damaged ({error})", path, _FIX) from error
    photos, cameras = pictures_by_stem(path.parent), list[ListedCamera]()
    for row in rows:
        picture = picture_of(photos, row["name"])
        cameras.append((row["name"] if picture is None else picture.stem, picture, partial(_shot, row, path)))
    found, missing = shots_of(cameras, path.parent, progress)
    return Capture(found, "z", left_out=missing, has_unit=False)


def _shot(row: Mapping[str, str | None], path: Path, picture: Path) -> Shot | None:
    def value(name: str) -> float:
        try:
            return float(row.get(name) or ("" if name in _NEEDED else 0.0))
        except ValueError as error:
            raise PlgsError("not-numbers", f"{name} of {picture.name} is not a number", path, _FIX) from error

    width, height = read_image_header(picture).size
    longer = max(width, height)
    focal = value("f") * longer / _FILM
    middle = width / 2.0 + value("px") * longer, height / 2.0 + value("py") * longer
    lens = pinhole(width, height, focal, focal, *middle, path=path, fix=_FIX, whose=picture.name)
    turn = _turn("z", -value("heading")) @ _turn("x", value("pitch")) @ _turn("y", value("roll"))
    pose = finite_pose(as_pose(turn, [value("x"), value("y"), value("alt")]), path)
    radial = tuple(value(f"k{power}") for power in range(1, 5))
    distortion = Distortion(radial, (), (value("t1"), value("t2")))
    return None if pose is None else Shot(picture.stem, lens.at(from_opengl(pose)), picture, distortion=distortion)


def _turn(axis: str, degrees: float) -> NDArray[np.float64]:
    """Return the rotation about an axis, float64 [3, 3]."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    one, other = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[[one, one, other, other], [one, other, one, other]] = cosine, -sine, sine, cosine
    return turn


FORMAT = SceneFormat("reality", lambda place: _file(place) is not None, _read)
