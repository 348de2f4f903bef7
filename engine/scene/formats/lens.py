"""Lenses: checked intrinsics, and distortion, which is removed on reading so that the engine sees only pinholes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import same_shape, shown_size
from ..frame import Inferred

_LEAST_SEEN = 0.1
"""Share of an undistorted picture that the distorted one shows, at least. Wide fisheyes show all of it."""
UNDISTORTED = "the lens distorts: pictures are undistorted on reading, and masks must be of the undistorted pictures"


def pinhole(
    width: float,
    height: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    *,
    path: Path,
    fix: str,
    whose: str = "a camera",
) -> Camera:
    """A camera at the origin, pixel centres at +0.5, for pictures of ``width`` x ``height``. Raises PlgsError for
    intrinsics that no camera has; ``path`` and ``whose`` name their source."""
    fits = 0.0 <= cx <= width < 2**16 and 0.0 <= cy <= height < 2**16
    if not (fits and 0.0 < fx < 1e6 and 0.0 < fy < 1e6 and width >= 1.0 and height >= 1.0):
        what = f"{whose} has intrinsics that no camera has with pictures of {width:.0f}x{height:.0f}"
        raise PlgsError("bad-intrinsics", what, path, fix)
    return Camera(round(width), round(height), float(fx), float(fy), float(cx), float(cy), np.eye(4))


def fitted(lens: Camera, picture: Path, fix: str) -> Camera:
    """``lens`` at the size of an image file. Raises PlgsError when it is for pictures of another shape."""
    size = read_image_header(picture).size
    if not same_shape(size, lens.size):
        what = f"the picture is {shown_size(size)}, but its camera {shown_size(lens.size)}"
        raise PlgsError("other-size", what, picture, fix)
    return lens.resized(*size)


def assumed(whose: str, lens: Camera, file: str) -> Inferred:
    """What a scene notes when no file says its lens, and ``whose`` is taken; ``file`` can say it."""
    values = " ".join(f"{value:.6g}" for value in (lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5))
    taken = f"{whose} lens is assumed ({values} for {shown_size(lens.size)})"
    return Inferred("lens", taken, f"no file says theirs; write it into {file} if it is another")


@dataclass(frozen=True)
class Distortion:
    """OpenCV's coefficients: k1 k2 p1 p2 k3 k4 k5 k6 of its "brown" model, or k1 k2 k3 k4 of its "fisheye" model."""

    model: Literal["brown", "fisheye"]
    coefficients: tuple[float, ...]

    @property
    def bends(self) -> bool:
        return self.model == "fisheye" or any(self.coefficients)


STRAIGHT = Distortion("brown", ())


def undistorted(pixels: NDArray[Any], lens: Camera, distortion: Distortion, path: Path, smooth: bool) -> NDArray[Any]:
    """A picture or depth map [H, W, ...] as a pinhole of the same focal lengths sees it; 0 beyond its edges. ``smooth``
    mixes neighbouring pixels. Raises PlgsError, naming ``path``, when OpenCV cannot do it."""
    import cv2

    height, width = pixels.shape[:2]
    own = lens.resized(width, height)
    try:
        x, y, share = _source_pixels(width, height, own.fx, own.fy, own.cx, own.cy, distortion)
        if share < _LEAST_SEEN:
            values = ", ".join(f"{value:.4g}" for value in distortion.coefficients)
            what = f"the lens distorts so much that {share:.0%} of the picture is left (its distortion: {values})"
            raise PlgsError("lens-distorts", what, path, "Correct the distortion, or undistort the pictures first.")
        return cv2.remap(pixels, x, y, cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    except cv2.error as error:
        fix = "Undistort the pictures first, and give pinhole cameras."
        raise PlgsError("lens-unsolved", f"the lens cannot be undistorted ({error.err})", path, fix) from error


@lru_cache(maxsize=4)
def _source_pixels(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Distortion
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Where each pixel of the undistorted picture lies in the distorted one, float32 [H, W] x and y, and the share of
    those that lie in it."""
    import cv2

    # OpenCV counts pixels from their centres.
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    build = cv2.fisheye.initUndistortRectifyMap if distortion.model == "fisheye" else cv2.initUndistortRectifyMap
    coefficients = np.array(distortion.coefficients)
    x, y = build(K, coefficients, np.eye(3), K, (width, height), cv2.CV_32FC1)
    return x, y, float(np.mean((x >= 0.0) & (x < width) & (y >= 0.0) & (y < height)))  # type: ignore[return-value]
