"""Hypersim's pixels from HDF5: tilted lenses straightened, distances made planar, linear colour tone mapped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError, lacks_part
from ...posed.camera import Camera

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_STRAIGHT = 1e-6
_LARGEST = 2**27
"""The largest number of values in one array: a picture of 8192x5461 in colour."""
_FIX = "Download this file again."
_BRIGHT, _BRIGHT_SHARE, _GAMMA = 0.8, 90.0, 1.0 / 2.2
"""The project's tool brings the 90th percentile of brightness to 0.8, after a gamma of 1 / 2.2."""


@dataclass(frozen=True)
class Projection:
    """The rays of the pixels of a ``width`` x ``height`` picture.

    ``rays`` is M_cam_from_uv, nine numbers, row by row: (u, v, 1), with u to the right and v up in -1..1, to a ray in
    OpenGL axes.
    """

    width: int
    height: int
    rays: tuple[float, ...]

    @property
    def is_tilted(self) -> bool:
        """Whether the picture's plane is tilted against the viewing direction, so that no pinhole has its rays."""
        ray = self.ray_of_pixel()
        return bool(np.abs(np.array([ray[0, 1], ray[1, 0], *(ray[2, :2])]) * self.width).max() > _STRAIGHT * 1e3)

    def ray_of_pixel(self) -> NDArray[np.float64]:
        """From (x, y, 1), pixel centres at +0.5, to a ray in OpenCV axes, float64 [3, 3]; z is 1 in the middle."""
        to_uv = np.array([[2.0 / self.width, 0.0, -1.0], [0.0, -2.0 / self.height, 1.0], [0.0, 0.0, 1.0]])
        matrix = _TO_OPENCV @ np.array(self.rays).reshape(3, 3) @ to_uv
        return np.asarray(matrix / (matrix[2] @ [self.width / 2.0, self.height / 2.0, 1.0]))

    def pinhole(self) -> Camera:
        """A camera at the origin that sees the same in the middle, and everywhere if the lens is not tilted."""
        ray = self.ray_of_pixel()
        middle = ray @ [self.width / 2.0, self.height / 2.0, 1.0]
        fx, fy = 1.0 / ray[0, 0], 1.0 / ray[1, 1]
        cx, cy = self.width / 2.0 - fx * middle[0], self.height / 2.0 - fy * middle[1]
        return Camera(self.width, self.height, float(fx), float(fy), float(cx), float(cy), np.eye(4))


@lru_cache(maxsize=4)
def _source_pixels(projection: Projection) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The place of each pixel of the pinhole's picture in the tilted one, from centres, float32 [H, W] x and y."""
    warp = np.linalg.inv(projection.ray_of_pixel()) @ np.linalg.inv(projection.pinhole().K)
    x, y = np.meshgrid(np.arange(projection.width) + 0.5, np.arange(projection.height) + 0.5)
    source = np.stack([x, y, np.ones_like(x)], axis=-1) @ warp.T
    # Rays behind the tilted plane do not belong to its pixels.
    scale = np.where(source[..., 2] > 1e-9, source[..., 2], np.nan)
    u, v = source[..., 0] / scale - 0.5, source[..., 1] / scale - 0.5
    return np.nan_to_num(u, nan=-1e6).astype(np.float32), np.nan_to_num(v, nan=-1e6).astype(np.float32)


def _straighten(pixels: NDArray[Any], projection: Projection, smooth: bool) -> NDArray[Any]:
    import cv2

    return cv2.remap(pixels, *_source_pixels(projection), cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)


def straightened(read: Callable[[], NDArray[np.uint8]], projection: Projection) -> NDArray[np.uint8]:
    """The tilted picture that ``read`` gives, uint8 [H, W, 3], straight; black beyond its edges. Raises PlgsError."""
    return _straighten(read(), projection, smooth=True)


def planar_depth(path: Path, projection: Projection) -> NDArray[np.float32]:
    """Planar depth, float32 [H, W] metres, 0 = none, of distances to the camera's centre. Raises PlgsError."""
    distance = read_hdf5(path, 2).astype(np.float64)
    if distance.shape != (projection.height, projection.width):
        raise PlgsError("depth and colour differ in size", path, "Download the scene again.")
    x, y = np.meshgrid(np.arange(projection.width) + 0.5, np.arange(projection.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ projection.ray_of_pixel().T
    depth = distance * rays[..., 2] / np.linalg.norm(rays, axis=-1)
    depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)
    return _straighten(depth, projection, smooth=False) if projection.is_tilted else depth


def tone_mapped(path: Path) -> NDArray[np.uint8]:
    """A linear picture, tone mapped to uint8 [H, W, 3] RGB. Raises PlgsError."""
    linear = np.nan_to_num(read_hdf5(path, 3).astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if linear.shape[2] != 3:
        raise PlgsError("the picture does not have three channels", path, "Download it again.")
    bright = float(np.percentile(linear @ np.array([0.3, 0.59, 0.11], np.float32), _BRIGHT_SHARE))
    scale = _BRIGHT ** (1.0 / _GAMMA) / bright if bright > 1e-4 else 0.0
    mapped = np.clip(np.maximum(scale * linear, 0.0) ** _GAMMA, 0.0, 1.0)
    return np.round(mapped * 255.0).astype(np.uint8)


def read_hdf5(path: Path, dimensions: int) -> NDArray[Any]:
    """The array called "dataset", of numbers. Raises PlgsError."""
    with _dataset(path, dimensions) as dataset:
        values: NDArray[Any] = dataset[()]
    return values


def size_of_hdf5(path: Path) -> tuple[int, int]:
    """(width, height) of the picture [H, W, 3] called "dataset"; it is not read. Raises PlgsError."""
    with _dataset(path, 3) as dataset:
        height, width, _ = dataset.shape
        return int(width), int(height)


@contextmanager
def _dataset(path: Path, dimensions: int) -> Iterator[Any]:
    try:
        import h5py
    except ImportError as error:
        raise lacks_part("HDF5 files need the package h5py", path, "hypersim") from error
    if not path.is_file():
        raise PlgsError("the file is missing", path, _FIX)
    try:
        with h5py.File(path, "r") as file:  # is_file above: no FIFO
            dataset = file.get("dataset")
            if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
                raise PlgsError('there is no array of numbers called "dataset"', path, _FIX)
            if dataset.ndim != dimensions or not 0 < np.prod(dataset.shape, dtype=np.float64) <= _LARGEST:
                raise PlgsError(f"the array has the shape {dataset.shape}", path, _FIX)
            yield dataset
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise PlgsError("the file cannot be read, or is cut off", path, _FIX) from error
