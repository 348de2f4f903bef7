"""Polycam's raw export: ``keyframes/`` with images, cameras, depth and confidence named by microseconds.

A camera is a JSON file: ``t_00`` ... ``t_23``, the rows of camera-to-world, OpenGL axes, metres, y up; ``fx fy cx cy
width height``. After Polycam's optimisation there are ``corrected_images`` and ``corrected_cameras``, undistorted and
better; they are preferred. Depth is a 16-bit PNG in millimetres, smaller than colour; pixels of the lowest confidence
are dropped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import PlgsError
from ...json_file import read_json_object, take_number
from ...posed.layout import files_by_stem, files_if_any, require_all
from ..depth import png_depth, trusted
from .capture import Capture, SceneFormat, Shot
from .lens import fitted, pinhole
from .poses import finite_pose, from_opengl

_FIX = "Export the raw data from Polycam again."
_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_NOT_OPTIMISED = "the poses were not optimised (no corrected_cameras): they are ARKit's own, and pictures are distorted"


def _recognises(place: Path) -> bool:
    return (place / "keyframes").is_dir()


def _read(place: Path) -> Capture:
    """Open the keyframes; only headers of images are read. Raises PlgsError."""
    folder = place / "keyframes"
    is_corrected = (folder / "corrected_cameras").is_dir() and (folder / "corrected_images").is_dir()
    prefix = "corrected_" if is_corrected else ""
    cameras = files_by_stem(folder / f"{prefix}cameras", {".json"}, _FIX)
    images = files_by_stem(folder / f"{prefix}images", {".jpg", ".jpeg", ".png"}, _FIX)
    depths = files_if_any(folder / "depth", {".png"}, _FIX)
    levels = files_if_any(folder / "confidence", {".png"}, _FIX)
    names = [name for name in cameras if name in images]
    if not names:
        raise PlgsError("no image has a camera", folder, _FIX)
    if depths:
        require_all(names, depths, "depth", folder / "depth", _FIX)
    found = [(name, _shot(name, images[name], cameras[name], depths.get(name), levels.get(name))) for name in names]
    return Capture(found, "y", () if is_corrected else (_NOT_OPTIMISED,), up_is_known=True)


def _shot(name: str, image: Path, path: Path, depth: Path | None, level: Path | None) -> Shot:
    entry = read_json_object(path)
    values = [take_number(entry, key, "the camera", path) for key in _POSE]
    pose = finite_pose(np.array(values).reshape(3, 4), path)
    assert pose is not None  # take_number takes finite numbers only
    lens = pinhole(*(take_number(entry, key, "the camera", path) for key in _LENS), path=path, fix=_FIX)
    lens = fitted(lens, image, _FIX)
    depth_map = None if depth is None else trusted(png_depth(depth, lens), level)
    return Shot(name, lens.at(from_opengl(pose)), image, depth_map)


FORMAT = SceneFormat("polycam", _recognises, _read)
