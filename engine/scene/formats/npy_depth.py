"""Depth as NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import array_file
from ..frame import SceneError, Size
from ..pixels import resize_nearest


@dataclass(frozen=True)
class NpyDepthReader:
    """Reads one frame's depth from a .npy: metres as floats, or whole numbers of ``unit`` metres."""

    path: Path
    unit: float = 0.001

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none. Raises SceneError."""
        values = read_picture(self.path)
        depth = values.astype(np.float32) * np.float32(1.0 if values.dtype.kind == "f" else self.unit)
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))
        return resize_nearest(depth, size) if size else depth


def read_picture(path: Path) -> NDArray[Any]:
    """The array of numbers [H, W] in a .npy file; sides of length 1 beside are dropped. Raises SceneError."""
    values: NDArray[Any] = read_npy(path)
    while values.ndim > 2 and 1 in (values.shape[0], values.shape[-1]):
        values = values[0] if values.shape[0] == 1 else values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        raise SceneError("depth is no picture of numbers", path, "Save an array [height, width].")
    return values


def read_npy(path: Path) -> NDArray[np.generic]:
    """The array in a .npy file, never a pickled one. Raises SceneError."""
    return array_file.read_npy(path, "Save one array with numpy.save.")
