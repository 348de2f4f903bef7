"""What the sample's programs share: named random streams, and writing pictures with clear errors."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def stream(*parts: object) -> np.random.Generator:
    """Return a random generator seeded by the name ``parts``, so that draws do not depend on those for other names."""
    return np.random.default_rng(zlib.crc32("/".join(map(str, parts)).encode()))


def write_image(path: Path, pixels: NDArray[np.generic], how: Sequence[int] = ()) -> None:
    """Write pixels, [H, W] or B, G, R [H, W, 3]. ``how`` holds OpenCV's parameters and values. Raises OSError."""
    if not cv2.imwrite(str(path), np.ascontiguousarray(pixels), how):
        raise OSError(f"cannot be written: {path}. Choose a folder that you may write to, on a disk with space.")
