"""ARKitScenes (Apple): a video's folder of ``raw``, or of ``3dod`` with the same in ``VIDEO_frames``.

* ``wide/``, ``vga_wide/`` or ``lowres_wide/``: pictures ``VIDEO_SECONDS.png``; the largest are read. Their lenses are
  in ``<kind>_intrinsics/VIDEO_SECONDS.pincam``: ``width height fx fy cx cy``.
* ``lowres_wide.traj``: seconds, rotation (axis times radians) and translation in metres, ten times a second:
  world-to-camera, OpenCV axes, z up. Poses between two are interpolated.
* ``lowres_depth/``: 16-bit PNG in millimetres, 256x192; ``confidence/`` 0 to 2: pixels with 0 are dropped.

See DATA.md of github.com/apple/ARKitScenes. It does not say where pixels count from; their corners are assumed."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.frames import as_pose, inverse
from ...posed.layout import files_by_stem, shown_files
from ..depth import png_depth, trusted
from ..files_of_frames import files_if_any
from .capture import Capture, Found, Progress, SceneFormat, Shot, watched, with_picture
from .lens import fitted, pinhole
from .poses import nearest, numbers, read_rows

Value = TypeVar("Value")
_FIX = "Download the video's wide or lowres_wide, its intrinsics, lowres_depth and lowres_wide.traj again."
_KINDS, _TRAJECTORY = ("wide", "vga_wide", "lowres_wide"), "lowres_wide.traj"
_SAME = 0.02  # maximum difference in seconds between the files of one frame
_GAP = 0.25  # maximum seconds between two poses to interpolate between them


def _folder(place: Path) -> Path | None:
    """Return the folder with the trajectory: the given one, or its subfolder of frames; None without one."""
    inside = [each for each in shown_files(place, "*_frames")] if place.is_dir() else []
    return next((each for each in (place, *inside) if (each / _TRAJECTORY).is_file()), None)


def _read(place: Path, progress: Progress) -> Capture:
    folder = _folder(place)
    kind = next((kind for kind in _KINDS if folder is not None and any(shown_files(folder / kind, "*.png"))), None)
    if folder is None or kind is None:
        what = f"there is no {_TRAJECTORY} with pictures in {' or '.join(_KINDS)}"
        raise PlgsError("no-arkitscenes", what, place, _FIX)
    pictures = files_by_stem(folder / kind, {".png"}, _FIX)
    lenses = _by_time(files_by_stem(folder / f"{kind}_intrinsics", {".pincam"}, _FIX))
    depths, levels = (_by_time(files_if_any(folder / name, {".png"}, _FIX)) for name in ("lowres_depth", "confidence"))
    poses = _read_trajectory(folder / _TRAJECTORY)
    found: list[tuple[str, Found]] = []
    for seconds, picture in watched(sorted(_by_time(pictures).items()), progress):
        pose, lens = _pose_at(poses, seconds), _nearest(lenses, seconds)
        depth, level = _nearest(depths, seconds), _nearest(levels, seconds)
        make = None if pose is None or lens is None else partial(_shot, picture, lens, depth, level, pose)
        found.append((picture.stem, with_picture(picture, make)))
    return Capture(found, "z", up_is_known=True)


def _by_time(files: Mapping[str, Path]) -> dict[float, Path]:
    """Return the files by the seconds at the end of their names. Raises PlgsError for a name without them."""
    found = {}
    for stem, path in files.items():
        try:
            found[float(stem.rpartition("_")[2])] = path
        except ValueError as error:
            raise PlgsError("no-time-stamp", "the name must end in seconds, as in VIDEO_98.764", path, _FIX) from error
    return dict(sorted(found.items()))


def _nearest(of_times: Mapping[float, Value], seconds: float) -> Value | None:
    times = [*of_times]
    index = nearest(times, seconds, _SAME)
    return None if index is None else of_times[times[index]]


def _read_trajectory(path: Path) -> dict[float, NDArray[np.float64]]:
    """Read camera-to-world poses, float64 [4, 4], by ascending seconds. Raises PlgsError for other texts."""
    import cv2

    found = {}
    for row in read_rows(path, _FIX):
        values = numbers(row, path, _FIX, 7)
        if np.isfinite(values).all():
            found[float(values[0])] = inverse(as_pose(cv2.Rodrigues(values[1:4])[0], values[4:]))
    if not found:
        raise PlgsError("no-poses-left", "the file holds no pose", path, _FIX)
    return dict(sorted(found.items()))


def _pose_at(poses: Mapping[float, NDArray[np.float64]], seconds: float) -> NDArray[np.float64] | None:
    """Return the interpolated pose, float64 [4, 4], at this time; None if the poses around it are too far apart."""
    import cv2

    times: Sequence[float] = [*poses]
    after = bisect_left(times, seconds)
    if 0 < after < len(times) and times[after] - times[after - 1] <= _GAP:
        one, other = times[after - 1], times[after]
        share = (seconds - one) / (other - one)
        between = (1 - share) * poses[one] + share * poses[other]
        turn = cv2.Rodrigues(poses[one][:3, :3].T @ poses[other][:3, :3])[0]  # axis times radians between both
        between[:3, :3] = poses[one][:3, :3] @ cv2.Rodrigues(share * turn)[0]
        return between
    return _nearest(poses, seconds)  # before the first, after the last, or in a gap


def _shot(picture: Path, lens: Path, depth: Path | None, level: Path | None, pose: NDArray[np.float64]) -> Shot:
    row = next(read_rows(lens, _FIX), None)
    if row is None:
        raise PlgsError("no-camera", "the file holds no camera", lens, _FIX)
    camera = fitted(pinhole(*numbers(row, lens, _FIX, 6).tolist(), path=lens, fix=_FIX), picture, _FIX)
    depth_map = None if depth is None else trusted(png_depth(depth, camera), level)
    return Shot(picture.stem, camera.at(pose), picture, depth_map)


FORMAT = SceneFormat("arkitscenes", lambda place: _folder(place) is not None, _read)
