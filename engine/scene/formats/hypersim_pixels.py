"""Hypersim's pixels: tilted lenses straightened, distances made planar depth, linear colour tone mapped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..frame import SceneError, Size
from ..pixels import resize_colour, resize_nearest
from .hdf5 import read_hdf5

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_STRAIGHT = 1e-6
_BRIGHT, _BRIGHT_SHARE, _GAMMA = 0.8, 90.0, 1.0 / 2.2
"""The project's tool brings the 90th percentile of brightness to 0.8, after a gamma of 1 / 2.2."""


@dataclass(frozen=True)
class Projection:
    """Which rays the pixels of a ``width`` x ``height`` picture see.

    ``rays`` is M_cam_from_uv, nine numbers, row by row: (u, v, 1), with u to the right and v up in -1..1, to a ray in
    OpenGL axes.
    """

    width: int
    height: int
    rays: tuple[float, ...]

    @property
    def is_tilted(self) -> bool:
        """Whether the picture's plane is not upright to where the camera looks, so that no pinhole has its rays."""
        ray = self.ray_of_pixel()
        return bool(np.abs(np.array([ray[0, 1], ray[1, 0], *(ray[2, :2])]) * self.width).max() > _STRAIGHT * 1e3)

    def ray_of_pixel(self) -> NDArray[np.float64]:
        """From (x, y, 1), pixel centres at +0.5, to a ray in OpenCV axes, float64 [3, 3]; z is 1 in the middle."""
        to_uv = np.array([[2.0 / self.width, 0.0, -1.0], [0.0, -2.0 / self.height, 1.0], [0.0, 0.0, 1.0]])
        matrix = _TO_OPENCV @ np.array(self.rays).reshape(3, 3) @ to_uv
        return np.asarray(matrix / (matrix[2] @ [self.width / 2.0, self.height / 2.0, 1.0]))

    def pinhole(self) -> Camera:
        """A camera at the origin: it sees the same in the middle, and everywhere where nothing is tilted."""
        ray = self.ray_of_pixel()
        middle = ray @ [self.width / 2.0, self.height / 2.0, 1.0]
        fx, fy = 1.0 / ray[0, 0], 1.0 / ray[1, 1]
        cx, cy = self.width / 2.0 - fx * middle[0], self.height / 2.0 - fy * middle[1]
        return Camera(self.width, self.height, float(fx), float(fy), float(cx), float(cy), np.eye(4))


@lru_cache(maxsize=4)
def _source_pixels(projection: Projection) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of the pinhole's picture lies in the tilted one, from pixel centres, float32 [H, W] x and y."""
    warp = np.linalg.inv(projection.ray_of_pixel()) @ np.linalg.inv(projection.pinhole().K)
    x, y = np.meshgrid(np.arange(projection.width) + 0.5, np.arange(projection.height) + 0.5)
    source = np.stack([x, y, np.ones_like(x)], axis=-1) @ warp.T
    # Rays behind the tilted plane are none of its pixels.
    scale = np.where(source[..., 2] > 1e-9, source[..., 2], np.nan)
    u, v = source[..., 0] / scale - 0.5, source[..., 1] / scale - 0.5
    return np.nan_to_num(u, nan=-1e6).astype(np.float32), np.nan_to_num(v, nan=-1e6).astype(np.float32)


def _straighten(pixels: NDArray[Any], projection: Projection, smooth: bool) -> NDArray[Any]:
    import cv2

    return cv2.remap(pixels, *_source_pixels(projection), cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)


@dataclass(frozen=True, eq=False)
class StraightColour:
    """Reads a tilted picture through ``read`` and straightens it; black where it does not reach."""

    read: Callable[[Size | None], NDArray[np.uint8]]
    projection: Projection

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB. Raises SceneError."""
        straight = _straighten(self.read((self.projection.width, self.projection.height)), self.projection, smooth=True)
        return resize_colour(straight, size) if size else straight


@dataclass(frozen=True)
class PlanarDepth:
    """Reads distances to the camera's centre and makes planar depth of them."""

    path: Path
    projection: Projection

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none. Raises SceneError."""
        distance = read_hdf5(self.path, 2).astype(np.float64)
        own = (self.projection.width, self.projection.height)
        if distance.shape != own[::-1]:
            raise SceneError("depth has another size than colour", self.path, "Download the scene again.")
        x, y = np.meshgrid(np.arange(own[0]) + 0.5, np.arange(own[1]) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.projection.ray_of_pixel().T
        depth = distance * rays[..., 2] / np.linalg.norm(rays, axis=-1)
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)
        if self.projection.is_tilted:
            depth = _straighten(depth, self.projection, smooth=False)
        return resize_nearest(depth, size) if size else depth


@dataclass(frozen=True)
class ToneMapped:
    """Reads a linear picture and tone maps it."""

    path: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB at ``size`` (width, height) or its own. Raises SceneError."""
        linear = np.nan_to_num(read_hdf5(self.path, 3).astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        if linear.shape[2] != 3:
            raise SceneError("the picture has no three channels", self.path, "Download it again.")
        bright = float(np.percentile(linear @ np.array([0.3, 0.59, 0.11], np.float32), _BRIGHT_SHARE))
        scale = _BRIGHT ** (1.0 / _GAMMA) / bright if bright > 1e-4 else 0.0
        mapped = np.clip(np.maximum(scale * linear, 0.0) ** _GAMMA, 0.0, 1.0)
        pixels = np.round(mapped * 255.0).astype(np.uint8)
        return resize_colour(pixels, size) if size else pixels
