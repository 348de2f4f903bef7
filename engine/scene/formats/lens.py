"""Lenses: checked intrinsics, and distortion, which is removed on reading so that the engine sees only pinhole cameras.
Only ``of_opencv``, ``of_nerfstudio`` and ``of_colmap`` know how each tool orders and defines its coefficients."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import same_shape, shown_size
from ..frame import Inferred, Size

Values = NDArray[np.float64]

_LEAST_SEEN = 0.1  # minimum fraction of an undistorted picture that the distorted one covers; wide fisheyes cover all
UNDISTORTED = "the lens distorts: pictures are undistorted on reading, and masks where they fit the photos as taken"


def pinhole(
    width: float, height: float, fx: float, fy: float, cx: float, cy: float,
    *, path: Path, fix: str, whose: str = "a camera",
) -> Camera:  # fmt: skip
    """Return a camera at the origin, pixel centres at +0.5, for pictures of ``width`` x ``height``. Raises PlgsError,
    with ``fix`` as the advice, for intrinsics that no camera has; ``path`` and ``whose`` name their source."""
    fits = 0.0 <= cx <= width < 2**16 and 0.0 <= cy <= height < 2**16
    if not (fits and 0.0 < fx < 1e6 and 0.0 < fy < 1e6 and width >= 1.0 and height >= 1.0):
        what = f"{whose} has intrinsics that are impossible for pictures of {width:.0f}x{height:.0f}"
        raise PlgsError("bad-intrinsics", what, path, fix)
    return Camera(round(width), round(height), float(fx), float(fy), float(cx), float(cy), np.eye(4))


def fitted(lens: Camera, picture: Path, fix: str) -> Camera:
    """Return ``lens`` scaled to an image's size. Raises PlgsError, with ``fix`` as advice, for other proportions."""
    size = read_image_header(picture).size
    if not same_shape(size, lens.size):
        what = f"the picture is {shown_size(size)}, but its camera is {shown_size(lens.size)}"
        raise PlgsError("other-size", what, picture, fix)
    return lens.resized(*size)


def assumed(whose: str, lens: Camera, file: str) -> Inferred:
    """A note that the lens of ``whose`` camera is assumed, as no file describes it; a user can write ``file``."""
    values = " ".join(f"{value:.6g}" for value in (lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5))
    taken = f"{whose} lens is assumed ({values} for {shown_size(lens.size)})"
    return Inferred("lens", taken, f"no file describes it; if it is different, write it into {file}")


@dataclass(frozen=True)
class Distortion:
    """How a lens distorts a pinhole camera's picture, in one formula for every tool's coefficients: ``bent``.
    ``radial`` are the factors of r^2, r^4, ... in its numerator, ``below`` those in its denominator, ``tangential`` p1
    and p2 in OpenCV's order, ``prism`` s1 s2 s3 s4. With ``is_fisheye``, all of them apply to angles from the axis.
    ``skew`` times the distorted y is added to the distorted x."""

    radial: tuple[float, ...] = ()
    below: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    is_fisheye: bool = False
    skew: float = 0.0

    @property
    def numbers(self) -> tuple[float, ...]:
        skew = (self.skew,) if self.skew else ()  # earlier lifts remember lenses without a skew
        return (*self.radial, *self.below, *self.tangential, *self.prism, *skew)

    @property
    def bends(self) -> bool:
        return self.is_fisheye or any(self.numbers)

    def bent(self, x: Values, y: Values) -> tuple[Values, Values]:
        """Return the distorted x and y of the point that a pinhole camera of focal length 1 shows at ``x`` and ``y``,
        floats of any shape: OpenCV's formula (calib3d, "Detailed Description"). Its fisheye model is the same, applied
        to coordinates whose length is the angle from the axis, and so is COLMAP's thin prism model (models.h)."""
        if self.is_fisheye:
            radius = np.maximum(np.hypot(x, y), 1e-12)  # avoids 0 / 0 in the middle
            x, y = (each * np.arctan(radius) / radius for each in (x, y))
        square = x * x + y * y
        factor = _series(self.radial, square) / _series(self.below, square)
        (p1, p2), (s1, s2, s3, s4) = self.tangential, self.prism
        across = x * factor + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + square * (s1 + square * s2)
        down = y * factor + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y + square * (s3 + square * s4)
        return across + self.skew * down, down


def _series(factors: tuple[float, ...], square: Values) -> Values:
    """Return 1 + k1 r^2 + k2 r^4 + ... for r^2 = ``square``."""
    total = np.zeros_like(square)
    for factor in reversed(factors):  # Horner's rule, from the highest power
        total = square * (factor + total)
    return 1.0 + total


STRAIGHT = Distortion()
OPENCV_COUNTS = (0, 4, 5, 8, 12)  # numbers of coefficients that OpenCV accepts, without its last two, of the tilt
_OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
LENS_NUMBER = re.compile(r"[kpsb]\d|tau_?[xy]|ftheta_p\d|latlong|equirectangular")
"""Lens keys in transforms.json, from nerfstudio, instant-ngp and programs that extend them."""


def of_opencv(values: Sequence[float]) -> Distortion:
    """The distortion from OpenCV's order: k1 k2 p1 p2, then k3, then k4 k5 k6 of the denominator, then s1 s2 s3 s4."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*values, *[0.0] * 12)[:12]
    return Distortion((k1, k2, k3), (k4, k5, k6), (p1, p2), (s1, s2, s3, s4))


def of_nerfstudio(named: Mapping[str, float], model: str, is_fisheye: bool) -> Distortion:
    """Return the distortion from coefficients by their names in transforms.json. nerfstudio's k3 and k4 are factors of
    r^6 and r^8 (its camera_utils.py), and an OPENCV_FISHEYE uses angles; in a FULL_OPENCV, k4 k5 k6 are OpenCV's.
    Raises ValueError with the names of other coefficients, which no formula here supports."""
    is_full = not is_fisheye and (model == "FULL_OPENCV" or "k5" in named or "k6" in named)
    known = _OPENCV_NAMES if is_full else _OPENCV_NAMES[:6]
    if others := [name for name, value in named.items() if value and name not in known]:
        raise ValueError(", ".join(others))
    values = [named.get(name, 0.0) for name in _OPENCV_NAMES]
    if is_full:
        return of_opencv(values)
    k1, k2, p1, p2, k3, k4 = values[:6]
    return Distortion((k1, k2, k3, k4), tangential=(p1, p2), is_fisheye=is_fisheye)


def of_colmap(model: str, rest: Sequence[float]) -> Distortion | None:
    """The distortion from COLMAP's numbers after focal lengths and principal point (models.h); None if unknown."""
    is_fisheye = model.endswith("FISHEYE")
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, s1, s3 = rest
        return Distortion((k1, k2, k3, k4), (), (p1, p2), (s1, 0.0, s3, 0.0), is_fisheye)
    if model in ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL", "RADIAL"):
        return Distortion((*rest,), is_fisheye=is_fisheye)
    return of_opencv(rest) if model in ("SIMPLE_PINHOLE", "PINHOLE", "OPENCV", "FULL_OPENCV") else None


def undistorted(pixels: NDArray[Any], lens: Camera, distortion: Distortion, path: Path, smooth: bool) -> NDArray[Any]:
    """Return a picture, depth map or mask [H, W, ...] as a pinhole camera of the same intrinsics sees it; 0 beyond its
    edges. ``smooth`` interpolates. Raises PlgsError, naming ``path``, if little of the picture is left."""
    import cv2

    height, width = pixels.shape[:2]
    own = lens.resized(width, height)
    x, y, share = _source_pixels((width, height), (own.fx, own.fy, own.cx, own.cy), distortion)
    if share < _LEAST_SEEN:
        values = ", ".join(f"{value:.4g}" for value in distortion.numbers)
        what = f"the lens distorts so much that {share:.0%} of the picture is left (its distortion: {values})"
        raise PlgsError("lens-distorts", what, path, "Correct the distortion, or undistort the pictures first.")
    taken = pixels.astype(np.float32) if pixels.dtype == np.int32 else pixels  # ids are whole numbers below 2^24
    shown = cv2.remap(taken, x, y, cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    return shown.astype(pixels.dtype, copy=False)


@lru_cache(maxsize=4)
def _source_pixels(
    size: Size, lens: tuple[float, float, float, float], distortion: Distortion
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """For each pixel of the undistorted picture, its position in the distorted one, float32 [H, W] x and y with pixel
    centres at integers, and the fraction of positions inside the picture. ``lens``: fx, fy, cx, cy."""
    (width, height), (fx, fy, cx, cy) = size, lens
    across, down = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    with np.errstate(all="ignore"):
        u, v = distortion.bent(*np.meshgrid(across, down))
        u, v = u * fx + cx - 0.5, v * fy + cy - 0.5
    x, y = (np.where(np.isfinite(each), each.clip(-1e6, 1e6), -1e6).astype(np.float32) for each in (u, v))
    return x, y, float(np.mean((x >= 0.0) & (x < width) & (y >= 0.0) & (y < height)))
