"""Replica as NICE-SLAM rendered it, and as Semantic-NeRF and vMAP did.

* NICE-SLAM: ``results/frame000000.jpg`` and ``results/depth000000.png``, ``traj.txt``; ``cam_params.json`` in the
  folder above says fx fy cx cy and the depth's steps per metre, 6553.5.
* Semantic-NeRF, vMAP: ``rgb/rgb_0.png`` and ``depth/depth_0.png`` in millimetres, ``traj_w_c.txt``.

A trajectory has 16 numbers per line: camera-to-world, OpenCV axes, metres, z up; line n is picture n. Pixel centres are
integers. Without a file of intrinsics the lens sees 90 degrees: f = w / 2, c = (w - 1) / 2 and (h - 1) / 2.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import PlgsError
from ...json_file import read_json_object, take_number
from ...posed.camera import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import files_by_stem
from ..depth import MILLIMETRES, png_depth
from .capture import Capture, SceneFormat, Shot
from .lens import pinhole
from .poses import finite_pose
from .rows import matrix_rows

_STEPS_A_METRE = 6553.5
_FIX = "Write 16 numbers per line, camera-to-world."
_IMAGES = {".jpg", ".jpeg", ".png"}
_PARAMETERS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


def _recognises(place: Path) -> bool:
    return (place / "traj.txt").is_file() and (place / "results").is_dir()


def _recognises_vmap(place: Path) -> bool:
    return (place / "traj_w_c.txt").is_file() and (place / "rgb").is_dir()


def _read(place: Path) -> Capture:
    """Open a scene of NICE-SLAM's; only headers of images are read. Raises PlgsError."""
    results = _numbered(place / "results", _IMAGES, "frame")
    depths = _numbered(place / "results", {".png"}, "depth") if any((place / "results").glob("depth*.png")) else {}
    files = (folder / "cam_params.json" for folder in (place, place.parent))
    path = next((path for path in files if path.is_file()), None)
    if path is None:
        return _capture(place / "traj.txt", results, depths, None, 1.0 / _STEPS_A_METRE)
    camera = read_json_object(path).get("camera")
    if not isinstance(camera, dict):
        raise PlgsError('the file has no "camera"', path, "Add it, or remove the file.")
    width, height, fx, fy, cx, cy, scale = (take_number(camera, key, "camera", path) for key in _PARAMETERS)
    fix = "Correct it, or remove the file."
    if scale <= 0.0:
        raise PlgsError("the depth's scale is not above 0", path, fix)
    lens = pinhole(width, height, fx, fy, cx + 0.5, cy + 0.5, path=path, fix=fix)
    return _capture(place / "traj.txt", results, depths, lens, 1.0 / scale)


def _read_vmap(place: Path) -> Capture:
    """Open a scene of Semantic-NeRF's or vMAP's; only headers of images are read. Raises PlgsError."""
    depths = _numbered(place / "depth", {".png"}, "depth") if (place / "depth").is_dir() else {}
    return _capture(place / "traj_w_c.txt", _numbered(place / "rgb", _IMAGES, "rgb"), depths, None, MILLIMETRES)


def _numbered(folder: Path, suffixes: set[str], kind: str) -> dict[int, Path]:
    """Images by the number in their names, which begin with ``kind``. Raises PlgsError."""
    found = {}
    for stem, path in files_by_stem(folder, suffixes, f"Name pictures {kind} and a number.").items():
        number = re.fullmatch(rf"{kind}_?(\d+)", stem)
        if number:
            found[int(number[1])] = path
    if not found:
        raise PlgsError(f"no picture is named {kind} and a number", folder, "Name them by their trajectory's lines.")
    return dict(sorted(found.items()))


def _capture(
    trajectory: Path, colours: dict[int, Path], depths: dict[int, Path], lens: Camera | None, unit: float
) -> Capture:
    matrices = list(matrix_rows(trajectory, _FIX))
    if colours and max(colours) >= len(matrices):
        what = f"there are {len(matrices)} poses, but a picture {max(colours)}"
        raise PlgsError(what, trajectory, "Number pictures from 0, and give each a pose.")
    found: list[tuple[str, Shot | None]] = []
    for number, path in colours.items():
        pose = finite_pose(matrices[number], trajectory)
        if pose is None:
            found.append((path.stem, None))
            continue
        width, height = read_image_header(path).size
        own = lens or Camera(width, height, width / 2.0, width / 2.0, width / 2.0, height / 2.0, np.eye(4))
        own = own.resized(width, height)
        depth = png_depth(depths[number], own, unit) if number in depths else None
        found.append((path.stem, Shot(path.stem, own.at(pose), path, depth)))
    return Capture(found, "z")


NICE_SLAM = SceneFormat("replica", _recognises, _read)
VMAP = SceneFormat("vmap", _recognises_vmap, _read_vmap)
