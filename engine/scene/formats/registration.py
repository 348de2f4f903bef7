"""Depth of a camera beside the colour camera, brought into the colour camera's picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..frame import Size
from ..pixels import resize_nearest


@dataclass(frozen=True, eq=False)
class RegisteredDepth:
    """Reads depth through ``read`` and shows it as the camera ``colour`` would see it.

    ``depth`` and ``colour`` are both lenses with poses that stand to each other as the two cameras do.
    """

    read: Callable[[Size | None], NDArray[np.float32]]
    depth: Camera
    colour: Camera

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none, also where only the colour camera sees. Raises SceneError."""
        raw = self.read(None)
        height, width = raw.shape
        points = self.depth.resized(width, height).unproject(raw)[raw > 0.0]
        pixels, z = self.colour.resized(width, height).project(points)
        columns, rows = np.floor(pixels).astype(np.int64).T
        inside = (z > 0.0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        registered = np.full(height * width, np.inf, np.float32)
        # The nearest of all surfaces that fall into a pixel hides the others.
        np.minimum.at(registered, rows[inside] * width + columns[inside], z[inside].astype(np.float32))
        registered[np.isinf(registered)] = 0.0
        image = registered.reshape(height, width)
        return resize_nearest(image, size) if size else image
