"""Replica as NICE-SLAM rendered it, and as Semantic-NeRF and vMAP did.

* NICE-SLAM: ``results/frame000000.jpg`` and ``results/depth000000.png``, ``traj.txt``; ``cam_params.json`` in the
  folder above says fx fy cx cy and the depth's steps a metre, 6553.5.
* Semantic-NeRF, vMAP: ``rgb/rgb_0.png`` and ``depth/depth_0.png`` in millimetres, ``traj_w_c.txt``.

A trajectory has 16 numbers a line: camera-to-world, OpenCV axes, metres, z up; line n is picture n. Pixel centres are
integers; without a file that says otherwise the lens sees 90 degrees: f = w / 2, c = (w - 1) / 2 and (h - 1) / 2.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..camera import Camera
from ..colour import ColourReader
from ..depth import MILLIMETRES, DepthReader, check_depth_header
from ..frame import SceneError, Size
from ..image_header import read_image_header
from ..json_file import read_json_object, take_number
from ..layout import files_by_stem
from ..matrices import placed
from .capture import Capture, Shot
from .poses import finite_pose
from .rows import matrix_rows

LOOKS_FOR = "traj.txt with results/frame000000.jpg"
LOOKS_FOR_VMAP = "traj_w_c.txt with the folders rgb and depth"
_STEPS_A_METRE = 6553.5
_FIX = "Write 16 numbers a line, camera-to-world."
_IMAGES = {".jpg", ".jpeg", ".png"}
_PARAMETERS = ("fx", "fy", "cx", "cy", "w", "h", "scale")


def recognises(place: Path) -> bool:
    return (place / "traj.txt").is_file() and (place / "results").is_dir()


def recognises_vmap(place: Path) -> bool:
    return (place / "traj_w_c.txt").is_file() and (place / "rgb").is_dir()


def read(place: Path) -> Capture:
    """Open a scene of NICE-SLAM's; only headers of images are read. Raises SceneError."""
    results = _numbered(place / "results", {".jpg", ".jpeg", ".png"}, "frame")
    depths = _numbered(place / "results", {".png"}, "depth") if any((place / "results").glob("depth*.png")) else {}
    parameters = next((path for path in (place, place.parent) if (path / "cam_params.json").is_file()), None)
    if parameters is None:
        return _read(place / "traj.txt", results, depths, None, 1.0 / _STEPS_A_METRE)
    path = parameters / "cam_params.json"
    camera = read_json_object(path).get("camera")
    if not isinstance(camera, dict):
        raise SceneError('the file has no "camera"', path, "Add it, or remove the file.")
    fx, fy, cx, cy, width, height, scale = (take_number(camera, key, "camera", path) for key in _PARAMETERS)
    if min(fx, fy, width, height, scale) <= 0.0:
        raise SceneError("the intrinsics are those of no camera", path, "Correct it, or remove the file.")
    lens = Camera(round(width), round(height), fx, fy, cx + 0.5, cy + 0.5, np.eye(4))
    return _read(place / "traj.txt", results, depths, lens, 1.0 / scale)


def read_vmap(place: Path) -> Capture:
    """Open a scene of Semantic-NeRF's or vMAP's; only headers of images are read. Raises SceneError."""
    depths = _numbered(place / "depth", {".png"}, "depth") if (place / "depth").is_dir() else {}
    return _read(place / "traj_w_c.txt", _numbered(place / "rgb", _IMAGES, "rgb"), depths, None, MILLIMETRES)


def _numbered(folder: Path, suffixes: set[str], kind: str) -> dict[int, Path]:
    """Images by the number in their names, which begin with ``kind``. Raises SceneError."""
    found = {}
    for stem, path in files_by_stem(folder, suffixes, f"Name pictures {kind} and a number.").items():
        number = re.fullmatch(rf"{kind}_?(\d+)", stem)
        if number:
            found[int(number[1])] = path
    if not found:
        raise SceneError(f"no picture is called {kind} and a number", folder, "Name them by their trajectory's lines.")
    return dict(sorted(found.items()))


def _read(
    trajectory: Path, colours: dict[int, Path], depths: dict[int, Path], lens: Camera | None, unit: float
) -> Capture:
    matrices = list(matrix_rows(trajectory, _FIX))
    if colours and max(colours) >= len(matrices):
        what = f"there are {len(matrices)} poses and a picture {max(colours)}"
        raise SceneError(what, trajectory, "Number pictures from 0, a pose each.")
    shots, lost = [], []
    for number, path in colours.items():
        pose = finite_pose(matrices[number], trajectory)
        if pose is None:
            lost.append(path.stem)
            continue
        size = read_image_header(path).size
        camera = placed(_wide_lens(size) if lens is None else lens.resized(*size), pose)
        depth = depths.get(number)
        if depths and depth is None:
            raise SceneError(f"picture {number} has no depth", path, "Give depth for all pictures or for none.")
        if depth is not None:
            check_depth_header(depth, camera)
        reader = None if depth is None else DepthReader(depth, unit=unit)
        shots.append(Shot(path.stem, camera, path, ColourReader(path), depth, reader))
    return Capture(tuple(shots), "z", tuple(lost))


def _wide_lens(size: Size) -> Camera:
    """A lens that sees 90 degrees, its axis in the middle of the picture."""
    width, height = size
    return Camera(width, height, width / 2.0, width / 2.0, width / 2.0, height / 2.0, np.eye(4))
