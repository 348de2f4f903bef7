"""Writing the files of samples: images and depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.scene.formats.room import Picture


def write_colour(path: Path, rgb: NDArray[np.uint8]) -> None:
    """uint8 [H, W, 3] RGB as PNG or as JPEG of the best quality."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 100]):
        raise OSError(path)


def write_grey(path: Path, values: NDArray[np.generic]) -> None:
    """A PNG with one channel, as deep as ``values``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), values):
        raise OSError(path)


def in_steps(depth: NDArray[np.float64], steps_a_metre: float) -> NDArray[np.uint16]:
    """Depth in metres as 16-bit whole steps."""
    return np.round(depth * steps_a_metre).astype(np.uint16)


def write_pair(colour: Path, depth: Path, picture: Picture, steps_a_metre: float = 1000) -> None:
    """A picture's colour as an image, its planar depth as a PNG of 16 bits."""
    write_colour(colour, picture.colour)
    write_grey(depth, in_steps(picture.depth, steps_a_metre))
