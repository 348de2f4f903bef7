"""Polycam's raw export: ``keyframes/`` with images, cameras, depth and confidence named by microseconds.

A camera is a JSON file: ``t_00`` ... ``t_23``, the rows of camera-to-world, OpenGL axes, metres, y up; ``fx fy cx cy
width height``. Where Polycam optimised the poses, ``corrected_images`` and ``corrected_cameras`` are undistorted and
better, and taken. Depth is a 16-bit PNG in millimetres, smaller than colour; what the sensor trusts least is dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..colour import ColourReader
from ..depth import DepthReader, check_depth_header
from ..frame import SceneError, Size
from ..image_header import read_image_header
from ..json_file import read_json_object, take_number
from ..layout import files_by_stem, require_all, same_shape, shown_size
from ..matrices import placed
from .capture import Capture, Shot
from .confidence import ConfidentDepth
from .poses import finite_pose, from_opengl

LOOKS_FOR = "keyframes/cameras and keyframes/images"
_FIX = "Export the raw data from Polycam again."
_IMAGES = {".jpg", ".jpeg", ".png"}
_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
_NOT_OPTIMISED = "the poses were not optimised (no corrected_cameras): they are ARKit's own, and pictures bend a little"


def recognises(place: Path) -> bool:
    return (place / "keyframes").is_dir()


def read(place: Path) -> Capture:
    """Open the keyframes; only headers of images are read. Raises SceneError."""
    folder = place / "keyframes"
    is_corrected = (folder / "corrected_cameras").is_dir() and (folder / "corrected_images").is_dir()
    prefix = "corrected_" if is_corrected else ""
    cameras = files_by_stem(folder / f"{prefix}cameras", {".json"}, _FIX)
    images = files_by_stem(folder / f"{prefix}images", _IMAGES, _FIX)
    depths = files_by_stem(folder / "depth", {".png"}, _FIX) if (folder / "depth").is_dir() else {}
    levels = files_by_stem(folder / "confidence", {".png"}, _FIX) if (folder / "confidence").is_dir() else {}
    names = [name for name in cameras if name in images]
    if not names:
        raise SceneError("no image has a camera", folder, _FIX)
    if depths:
        require_all(names, depths, "depth", folder / "depth", _FIX)
    shots = tuple(_shot(name, images[name], cameras[name], depths.get(name), levels.get(name)) for name in names)
    return Capture(shots, "y", warnings=() if is_corrected else (_NOT_OPTIMISED,), up_is_known=True)


def _shot(name: str, image: Path, camera_path: Path, depth: Path | None, level: Path | None) -> Shot:
    entry = read_json_object(camera_path)
    values = [take_number(entry, key, "the camera", camera_path) for key in _POSE]
    pose = finite_pose(np.array(values).reshape(3, 4), camera_path)
    fx, fy, cx, cy, width, height = (
        take_number(entry, key, "the camera", camera_path) for key in ("fx", "fy", "cx", "cy", "width", "height")
    )
    if pose is None or min(fx, fy, width, height) <= 0.0 or not (0.0 <= cx <= width and 0.0 <= cy <= height):
        raise SceneError("the intrinsics are those of no camera", camera_path, _FIX)
    size = read_image_header(image).size
    if not same_shape(size, (max(1, round(width)), max(1, round(height)))):
        what = f"the image is {shown_size(size)}, its camera {width:.0f}x{height:.0f}"
        raise SceneError(what, image, _FIX)
    lens = Camera(round(width), round(height), fx, fy, cx, cy, np.eye(4)).resized(*size)
    read_depth: Callable[[Size | None], NDArray[np.float32]] | None = None
    if depth is not None:
        check_depth_header(depth, lens)
        read_depth = DepthReader(depth)
        if level is not None:
            read_depth = ConfidentDepth(read_depth, level)
    return Shot(name, placed(lens, from_opengl(pose)), image, ColourReader(image), depth, read_depth)
