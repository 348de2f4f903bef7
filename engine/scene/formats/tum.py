"""TUM RGB-D sequences, and those recorded in their layout (Bonn, ETH3D SLAM).

* ``rgb.txt`` and ``depth.txt``: a time stamp and a file name per line; or ``associations.txt`` (``associated.txt``)
  with a colour and a depth image per line. Without either, images in ``rgb/`` and ``depth/`` are named by their stamps.
* ``groundtruth.txt``: ``t tx ty tz qx qy qz qw``, camera-to-world, OpenCV axes, metres.
  RTAB-Map adds a whole number, and optionally names pictures by it.
* Depth: 16-bit PNG, registered to colour, planar, 5000 steps per metre, 0 = none.
* ``calibration.txt`` (ETH3D): ``fx fy cx cy`` with integer pixel centres, then OpenCV's distortion. Without it, TUM's
  lens is chosen by "freiburg1" to "freiburg3" in the folder's name; otherwise a Kinect's is assumed, with a warning.

ICL-NUIM, whose stamps are whole numbers, is refused: its camera and world are mirrored in y."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import file_inside, files_by_stem
from ...scene_source import UpAxis
from ..depth import png_depth
from ..frame import Inferred, Size, left_out
from .capture import Capture, Found, Progress, SceneFormat, Shot, frame_names, watched, with_picture
from .lens import OPENCV_COUNTS, assumed, fitted, of_opencv, pinhole
from .photos import CONVERT
from .poses import nearest, numbers, quaternion_pose, read_rows

_STEP = 1.0 / 5000.0
_APART = 0.02  # maximum difference in seconds between a picture, its depth and its pose
_POSE_FIX = "Write one pose on each line, t tx ty tz qx qy qz qw, with points in decimals."
_LIST_FIX = "Write a time stamp and a file name on each line."
_CALIBRATION = "calibration.txt"
_LENS_FIX = f"Write fx fy cx cy of the pictures, and k1 k2 p1 p2 k3 if they are distorted, into {_CALIBRATION}."


@dataclass(frozen=True)
class _Lens:
    """Intrinsics with integer pixel centres, and OpenCV's distortion coefficients. ``up`` is the up axis of scenes
    taken with this lens, ``size`` the size of its pictures, None for any size."""

    fx: float
    fy: float
    cx: float
    cy: float
    bent: tuple[float, ...] = ()
    up: UpAxis | None = None
    size: Size | None = (640, 480)


_LENSES = {
    "freiburg1": _Lens(517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), "z"),
    "freiburg2": _Lens(520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), "z"),
    "freiburg3": _Lens(535.4, 539.2, 320.1, 247.6, up="z"),
    "bonn": _Lens(542.822841, 542.576870, 315.593520, 237.756098),
}  # fmt: skip
_KINECT = _Lens(525.0, 525.0, 319.5, 239.5)


@dataclass(frozen=True)
class _Stamped:
    """An image, and the time when it was taken, in seconds."""

    time: float
    path: Path


_Pose = tuple[float, NDArray[np.float64] | None, float | None]
"""When a picture was taken, in seconds; its pose, None if a number in it is not finite; and its number, if any."""


def _read(place: Path, progress: Progress) -> Capture:
    calibration, pairs, inferred = place / _CALIBRATION, _pairs(place), tuple[Inferred, ...]()
    if calibration.is_file():
        rows = read_rows(calibration, _LENS_FIX)
        values = [float(each) for row in rows for each in numbers(row, calibration, _LENS_FIX)]
        if len(values) - 4 not in OPENCV_COUNTS:
            what = f"there are {len(values)} numbers, not fx fy cx cy and OpenCV's distortion coefficients"
            raise PlgsError("intrinsics-incomplete", what, calibration, _LENS_FIX)
        fx, fy, cx, cy, *bent = values
        lens = _Lens(fx, fy, cx, cy, (*bent,), size=None)
    else:
        whose = next((name for name in _LENSES if name in place.resolve().name.lower()), "a Kinect")
        lens = _LENSES.get(whose, _KINECT)
        inferred = (assumed(f"{whose}'s", _camera(lens, lens.size or (640, 480), place), _CALIBRATION),)
    poses = _read_poses(place / "groundtruth.txt")
    if pairs and {colour.time for colour, _ in pairs} <= {number for _, _, number in poses}:  # pictures have numbers
        poses = sorted(((number, pose, number) for _, pose, number in poses if number), key=lambda each: each[0])
    times = [time for time, _, _ in poses]
    names = frame_names([colour.path.relative_to(place).as_posix() for colour, _ in pairs])
    found: list[tuple[str, Found]] = []
    for name, (colour, depth) in watched([*zip(names, pairs, strict=True)], progress):
        index = nearest(times, colour.time, _APART)
        pose = None if index is None else poses[index][1]
        beside = None if depth is None else depth.path
        make = None if pose is None else partial(_shot, name, colour.path, beside, lens, pose)
        found.append((name, with_picture(colour.path, make)))
    blind = {name: shot for name, shot in found if isinstance(shot, Shot) and shot.depth is None}
    if len(blind) == sum(isinstance(shot, Shot) for _, shot in found):
        blind = {}  # a sequence without depth
    found = [(name, shot) for name, shot in found if name not in blind]
    without = left_out(f"depth within {_APART} s", blind)
    return Capture(found, lens.up, left_out=without, inferred=inferred)


def _pairs(place: Path) -> list[tuple[_Stamped, _Stamped | None]]:
    """Return the colour images by time, each with the depth image closest in time, None if that is too far in time."""
    lists = [place / name for name in ("associations.txt", "associated.txt") if (place / name).is_file()]
    if lists:
        pairs = []
        for row in read_rows(lists[0], "Write two time stamps, each with a file name, on each line."):
            one, two = _stamped(row.words[:2], row.line, lists[0]), _stamped(row.words[2:], row.line, lists[0])
            pairs.append((two, one) if one.path.parent.name == "depth" else (one, two))  # some list depth first
        return sorted(pairs, key=lambda pair: pair[0].time)
    colours = _stamped_images(place, "rgb")
    depths = _stamped_images(place, "depth") if (place / "depth").is_dir() else []
    times = [depth.time for depth in depths]
    indices = [nearest(times, colour.time, _APART) for colour in colours]
    return [(colour, None if i is None else depths[i]) for colour, i in zip(colours, indices, strict=True)]


def _stamped_images(place: Path, kind: str) -> list[_Stamped]:
    path = place / f"{kind}.txt"
    if path.is_file():
        images = [_stamped(row.words, row.line, path) for row in read_rows(path, _LIST_FIX)]
    else:
        files = files_by_stem(place / kind, {".png", ".jpg", ".jpeg"}, f"Put the images there, or write {kind}.txt.")
        images = [_stamped([stem, f"{kind}/{file.name}"], 0, path) for stem, file in files.items()]
    return sorted(images, key=lambda image: image.time)


def _stamped(words: Sequence[str], line: int, path: Path) -> _Stamped:
    try:
        time, name = words
        stamp = float(time)
    except ValueError as error:
        where = f"line {line}" if line else f'the name "{words[0]}"'
        raise PlgsError("no-time-stamp", f"{where} is not a time stamp with a file name", path, _LIST_FIX) from error
    return _Stamped(stamp, file_inside(path.parent, name, path))


def _read_poses(path: Path) -> list[_Pose]:
    """Read poses by ascending time, with the numbers that RTAB-Map gives them."""
    poses: list[_Pose] = []
    for row in read_rows(path, _POSE_FIX):
        if row.words[0].isdecimal():
            raise PlgsError("whole-time-stamps", "time stamps are frame numbers, as in ICL-NUIM", path, CONVERT)
        has_number = len(row.words) == 9 and row.words[8].isdecimal()
        values = numbers(row, path, _POSE_FIX, 9 if has_number else 8).tolist()
        time, tx, ty, tz, qx, qy, qz, qw = values[:8]
        pose = None
        if np.isfinite([tx, ty, tz, qx, qy, qz, qw]).all():
            pose = quaternion_pose((qw, qx, qy, qz), (tx, ty, tz), path)
        poses.append((time, pose, values[8] if has_number else None))
    return sorted(poses, key=lambda each: each[0])


def _shot(name: str, colour: Path, depth: Path | None, lens: _Lens, pose: NDArray[np.float64]) -> Shot:
    own = _camera(lens, lens.size or read_image_header(colour).size, colour.parent.parent)
    camera = fitted(own, colour, _LENS_FIX).at(pose)
    depth_map = None if depth is None else png_depth(depth, camera, _STEP)
    return Shot(name, camera, colour, depth_map, distortion=of_opencv(lens.bent))


def _camera(lens: _Lens, size: Size, place: Path) -> Camera:
    return pinhole(*size, lens.fx, lens.fy, lens.cx + 0.5, lens.cy + 0.5, path=place, fix=_LENS_FIX)


FORMAT = SceneFormat("tum", lambda place: (place / "rgb").is_dir() and (place / "groundtruth.txt").is_file(), _read)
