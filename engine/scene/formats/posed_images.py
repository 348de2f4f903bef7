"""ScanNet's ``posed_images``, as mmdetection3d exports them: pictures, poses and the lens in one folder.

``00000.jpg``, ``00000.txt`` camera-to-world, 4x4, OpenCV axes, metres (inf: lost tracking), and ``intrinsic.txt``, 3x3
or 4x4, in pixels of the pictures with integer pixel centres. Exports with depth have ``00000.png`` beside them: 16
bits, millimetres.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...posed.image_header import read_image_header
from ...posed.layout import natural_order
from ...posed.matrices import read_intrinsics, read_poses
from ..depth import png_depth
from .capture import Capture, SceneFormat, Shot, with_picture

_INTRINSICS = "intrinsic.txt"
_PICTURES = (".jpg", ".jpeg")


def _recognises(place: Path) -> bool:
    return (place / _INTRINSICS).is_file() and any(_pose_of(path).is_file() for path in _pictures(place))


def _pictures(folder: Path) -> list[Path]:
    return sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in _PICTURES),
        key=lambda path: natural_order(path.name),
    )


def _pose_of(picture: Path) -> Path:
    return picture.with_suffix(".txt")


def _read(folder: Path) -> Capture:
    """Open the frames; only headers of images are read. Raises PlgsError."""
    pictures = {path.stem: path for path in _pictures(folder)}
    poses = read_poses({name: _pose_of(path) for name, path in pictures.items()})
    shots = {name: with_picture(path, partial(_shot, folder, path, poses[name])) for name, path in pictures.items()}
    return Capture([*shots.items()], "z")


def _shot(folder: Path, picture: Path, pose: NDArray[np.float64] | None) -> Shot | None:
    """None without a pose, as where tracking was lost. Raises PlgsError."""
    if pose is None:
        return None
    lens, depth = read_intrinsics(folder / _INTRINSICS, read_image_header(picture).size), picture.with_suffix(".png")
    return Shot(picture.stem, lens.at(pose), picture, png_depth(depth, lens) if depth.is_file() else None)


FORMAT = SceneFormat("posed-images", _recognises, _read)
