"""Polycam's raw export: ``keyframes/`` with images, cameras, depth and confidence named by microseconds.

A camera is a JSON file: ``t_00`` ... ``t_23``, the rows of camera-to-world, OpenGL axes, metres, y up; ``fx fy cx cy
width height``; corrected ones may lack the last two. After Polycam's optimisation there are ``corrected_images`` and
``corrected_cameras``, undistorted and better; they are preferred, and keyframes without them are left out. Depth is a
16-bit PNG in millimetres, smaller than colour; pixels of the lowest confidence are dropped.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import PlgsError
from ...json_file import read_json_object, take_number
from ...posed.image_header import read_image_header
from ...posed.layout import files_by_stem, listed, natural_order, of_most
from ..depth import png_depth, trusted
from ..files_of_frames import files_if_any
from ..frame import Inferred
from .capture import Capture, SceneFormat, Shot, with_picture
from .lens import fitted, pinhole
from .poses import finite_pose, from_opengl

_FIX = "Export the raw data from Polycam again."
_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
_SIZE = ("width", "height")
_LENS = ("fx", "fy", "cx", "cy")
_IMAGES = {".jpg", ".jpeg", ".png"}
_NOT_OPTIMISED = "the poses were not optimised (no corrected_cameras): they are ARKit's own, and pictures are distorted"


def _recognises(place: Path) -> bool:
    return (place / "keyframes").is_dir()


def _read(place: Path) -> Capture:
    """Open the keyframes; only headers of images are read. Raises PlgsError."""
    folder = place / "keyframes"
    is_corrected = any(folder.glob("corrected_cameras/*.json")) and (folder / "corrected_images").is_dir()
    prefix = "corrected_" if is_corrected else ""
    cameras = files_by_stem(folder / f"{prefix}cameras", {".json"}, _FIX)
    images = files_by_stem(folder / f"{prefix}images", _IMAGES, _FIX)
    raw = {path.stem: path for path in (folder / "cameras").glob("*.json")} if is_corrected else cameras
    depths = files_if_any(folder / "depth", {".png"}, _FIX)
    levels = files_if_any(folder / "confidence", {".png"}, _FIX)
    entries = of_most([name for name in cameras if name in images], lambda name: read_json_object(cameras[name]))
    if not entries:
        raise PlgsError("no image has a camera", folder, _FIX)
    found: dict[str, Shot | PlgsError | None] = dict.fromkeys(sorted({*raw, *cameras, *images}, key=natural_order))
    for name, entry in entries.items():
        size = _size(entry, images[name], cameras[name], raw.get(name))
        make = partial(_shot, name, entry, size, images[name], cameras[name], depths.get(name), levels.get(name))
        found[name] = with_picture(images[name], make)
    told = [] if is_corrected else [_NOT_OPTIMISED]
    if len(entries) < len(found):
        lost = len(found) - len(entries)
        told.append(f"{lost} of {len(found)} keyframes are not in both {prefix}cameras and {prefix}images")
    sizeless = [name for name, entry in entries.items() if not _has_size(entry)]
    taken = f"the size of the pictures of {len(sizeless)} cameras, which do not say it, is inferred"
    reason = f"their principal points are nearest to its middle ({listed(sizeless)})"
    inferred = (Inferred("lens", taken, reason),) if sizeless else ()
    return Capture([*found.items()], "y", tuple(told), up_is_known=True, inferred=inferred)


def _has_size(entry: dict[str, Any]) -> bool:
    return all(key in entry for key in _SIZE)


def _size(entry: dict[str, Any], image: Path, path: Path, raw: Path | None) -> tuple[float, ...]:
    """The width and height that a camera's numbers are for. If it does not say, those of its picture or of the camera
    before optimisation, whose middle is nearer the principal point. Raises PlgsError."""
    if _has_size(entry):
        return tuple(take_number(entry, key, "the camera", path) for key in _SIZE)
    sizes: list[tuple[float, ...]] = [read_image_header(image).size]
    if raw is not None and _has_size(other := read_json_object(raw)):
        sizes.append(tuple(take_number(other, key, "the camera", raw) for key in _SIZE))
    middle = [take_number(entry, key, "the camera", path) for key in ("cx", "cy")]
    return min(sizes, key=lambda size: sum(abs(c - side / 2.0) for c, side in zip(middle, size, strict=True)))


def _shot(
    name: str, entry: dict[str, Any], size: tuple[float, ...], image: Path, path: Path, depth: Path | None,
    level: Path | None,
) -> Shot:  # fmt: skip
    values = [take_number(entry, key, "the camera", path) for key in _POSE]
    pose = finite_pose(np.array(values).reshape(3, 4), path)
    assert pose is not None  # take_number takes finite numbers only
    lens = pinhole(*size, *(take_number(entry, key, "the camera", path) for key in _LENS), path=path, fix=_FIX)
    lens = fitted(lens, image, _FIX)
    depth_map = None if depth is None else trusted(png_depth(depth, lens), level)
    return Shot(name, lens.at(from_opengl(pose)), image, depth_map)


FORMAT = SceneFormat("polycam", _recognises, _read)
