"""Lenses that bend: pictures and depth are undistorted on reading, so that the engine sees pinholes only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..frame import SceneError, Size
from ..pixels import resize_colour, resize_nearest

UNDISTORTED = "the lens bends: pictures are undistorted on reading, and masks must be of the undistorted pictures"


@dataclass(frozen=True)
class Distortion:
    """OpenCV's coefficients: k1 k2 p1 p2 k3 k4 k5 k6 of its "brown" model, or k1 k2 k3 k4 of its "fisheye" model."""

    model: Literal["brown", "fisheye"]
    coefficients: tuple[float, ...]

    @property
    def bends(self) -> bool:
        return self.model == "fisheye" or any(self.coefficients)


@dataclass(frozen=True)
class _Pinhole:
    """A camera's lens without its pose, fit to be a key."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, eq=False)
class UndistortedColour:
    """Reads a colour image through ``read`` and undistorts it for ``lens``, a pinhole of the same focal lengths."""

    read: Callable[[Size | None], NDArray[np.uint8]]
    lens: Camera
    distortion: Distortion
    path: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB; black where the picture does not reach. Raises SceneError."""
        straight = _straighten(self.read(None), self.lens, self.distortion, self.path, smooth=True)
        return resize_colour(straight, size) if size else straight


@dataclass(frozen=True, eq=False)
class UndistortedDepth:
    """Reads depth that lies on the distorted picture through ``read`` and undistorts it in the same way."""

    read: Callable[[Size | None], NDArray[np.float32]]
    lens: Camera
    distortion: Distortion
    path: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """float32 [H, W] metres, 0 = none, also where the picture does not reach. Raises SceneError."""
        straight = _straighten(self.read(None), self.lens, self.distortion, self.path, smooth=False)
        return resize_nearest(straight, size) if size else straight


def _straighten(pixels: NDArray[Any], lens: Camera, distortion: Distortion, path: Path, smooth: bool) -> NDArray[Any]:
    import cv2

    height, width = pixels.shape[:2]
    own = lens.resized(width, height)
    try:
        maps = _maps(_Pinhole(width, height, own.fx, own.fy, own.cx, own.cy), distortion)
        return cv2.remap(pixels, *maps, cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    except cv2.error as error:
        fix = "Undistort the pictures before, and give pinhole cameras."
        raise SceneError(f"the lens cannot be undistorted ({error.err})", path, fix) from error


@lru_cache(maxsize=4)
def _maps(lens: _Pinhole, distortion: Distortion) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of the undistorted picture lies in the distorted one, float32 [H, W] x and y."""
    import cv2

    # OpenCV counts pixels from their centres.
    K = np.array([[lens.fx, 0.0, lens.cx - 0.5], [0.0, lens.fy, lens.cy - 0.5], [0.0, 0.0, 1.0]])
    build = cv2.fisheye.initUndistortRectifyMap if distortion.model == "fisheye" else cv2.initUndistortRectifyMap
    coefficients = np.array(distortion.coefficients)
    return build(K, coefficients, np.eye(3), K, (lens.width, lens.height), cv2.CV_32FC1)  # type: ignore[return-value]
