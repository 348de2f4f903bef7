"""Replica as rendered by NICE-SLAM.

``results/frame000000.jpg`` and ``results/depth000000.png``; ``traj.txt``, 16 numbers per line: camera-to-world, OpenCV
axes, metres, z up; line n is picture n. ``cam_params.json`` there or in the folder above gives fx fy cx cy (integer
pixel centres) and the depth's steps per metre, 6553.5. Without it, a field of view of 90 degrees is assumed."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import read_json_object, take_number
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import files_by_stem, shown_files
from ..depth import fault_of, png_depth
from ..frame import Inferred
from .capture import Capture, Found, Progress, SceneFormat, Shot, watched, with_picture
from .lens import assumed, fitted, pinhole
from .poses import finite_pose, matrix_rows

_STEPS_A_METRE = 6553.5
_FIX = "Write 16 numbers per line, camera-to-world."
_IMAGES = {".jpg", ".jpeg", ".png"}
_LENS_FIX = "Write w, h, fx, fy, cx, cy and scale of the pictures into cam_params.json."
_PARAMETERS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


def _read(place: Path, progress: Progress) -> Capture:
    results, trajectory = place / "results", place / "traj.txt"
    colours = _numbered(results, _IMAGES, "frame")
    depths = _numbered(results, {".png"}, "depth") if any(shown_files(results, "depth*.png")) else {}
    lens, unit = _read_parameters(place) or (None, 1.0 / _STEPS_A_METRE)
    is_assumed = lens is None
    matrices = list(matrix_rows(trajectory, _FIX))
    if colours and max(colours) >= len(matrices):
        what = f"there are {len(matrices)} poses, but a picture number {max(colours)}"
        raise PlgsError("unequal-counts", what, trajectory, "Number pictures from 0, and give each a pose.")
    found: list[tuple[str, Found]] = []
    for number, path in watched([*colours.items()], progress):
        pose = finite_pose(matrices[number], trajectory)
        if lens is None and fault_of(path) is None:
            width, height = read_image_header(path).size
            lens = Camera(width, height, width / 2.0, width / 2.0, width / 2.0, height / 2.0, np.eye(4))
        make = None if pose is None else partial(_shot, path, depths.get(number), unit, lens, pose)
        found.append((path.stem, with_picture(path, make)))
    if not is_assumed or lens is None:
        return Capture(found, "z")
    steps = Inferred("units", f"a step of depth is {unit:.4g} m", "no cam_params.json says another", is_doubtful=False)
    return Capture(found, "z", inferred=(assumed("Replica's", lens, "cam_params.json"), steps))


def _numbered(folder: Path, suffixes: set[str], kind: str) -> dict[int, Path]:
    """Return images by the number in their names, which begin with ``kind``."""
    files = files_by_stem(folder, suffixes, f"Name pictures {kind} and a number.").items()
    found = {int(number[1]): path for stem, path in files if (number := re.fullmatch(rf"{kind}_?(\d+)", stem))}
    if not found:
        what = f"no picture is named {kind} and a number"
        raise PlgsError("unnumbered", what, folder, "Name them by their lines in the trajectory.")
    return dict(sorted(found.items()))


def _shot(path: Path, depth: Path | None, unit: float, lens: Camera | None, pose: NDArray[np.float64]) -> Shot:
    assert lens is not None  # the picture can be read
    own = fitted(lens, path, _LENS_FIX)
    return Shot(path.stem, own.at(pose), path, None if depth is None else png_depth(depth, own, unit))


def _read_parameters(place: Path) -> tuple[Camera, float] | None:
    """Return the lens and depth's unit in metres, from a file in ``place`` or the folder above; None without one."""
    files = (folder / "cam_params.json" for folder in (place, place.parent))
    path = next((path for path in files if path.is_file()), None)
    if path is None:
        return None
    camera = read_json_object(path).get("camera")
    if not isinstance(camera, dict):
        raise PlgsError("lacks-field", 'the file has no "camera"', path, "Add it, or remove the file.")
    width, height, fx, fy, cx, cy, scale = (take_number(camera, key, "camera", path) for key in _PARAMETERS)
    fix = "Correct the numbers, or remove the file."
    if scale <= 0.0:
        raise PlgsError("bad-scale", "the depth's scale is not above 0", path, fix)
    return pinhole(width, height, fx, fy, cx + 0.5, cy + 0.5, path=path, fix=fix), 1.0 / scale


FORMAT = SceneFormat("replica", lambda place: (place / "traj.txt").is_file() and (place / "results").is_dir(), _read)
