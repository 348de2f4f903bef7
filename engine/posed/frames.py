"""Posed cameras, and posed frames: all that Blender needs of a scene.

One convention everywhere in the engine: OpenCV axes (x right, y down, z forward), camera-to-world matrices in metres,
world z up, and pixel (i, j) centred at (i + 0.5, j + 0.5), so that ``cx = width / 2`` is the middle of the picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..job.cameras import Projection
from .classes import ClassTable


def as_pose(rotation: ArrayLike, position: ArrayLike) -> NDArray[np.float64]:
    """Build a rigid camera-to-world float64 [4, 4] from a rotation [3, 3] and a position [3]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a rigid transform, float64 [4, 4]."""
    return as_pose(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: intrinsics in pixels of a ``width`` x ``height`` picture (``cx``, ``cy``: the principal point), and the
    pose, a rigid float64 [4, 4] from camera to world. ``projection`` is "perspective", "orthographic" or
    "equirectangular". ``fx`` and ``fy`` are focal lengths in pixels in a perspective picture, as all frames are; pixels
    per metre in an orthographic one; pixels per radian of longitude and latitude in an equirectangular one, whose depth
    is the distance from the camera, not planar."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: NDArray[np.float64]
    projection: Projection = "perspective"

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height

    @property
    def K(self) -> NDArray[np.float64]:
        """The intrinsic matrix, float64 [3, 3], in pixels, where the centre of a pixel is at +0.5."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """The inverse pose, float64 [4, 4]; exact for a rigid matrix."""
        return inverse(self.camera_to_world)

    @property
    def centre(self) -> NDArray[np.float64]:
        """Camera centre in world metres, float64 [3]."""
        return self.camera_to_world[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera for a picture of another size (edges stay edges, so no half-pixel shift arises)."""
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def at(self, pose: NDArray[np.float64]) -> Camera:
        """Return the same intrinsics with another pose, float64 [4, 4] camera-to-world."""
        return replace(self, camera_to_world=pose)

    def of_rows(self, first: int, end: int) -> Camera:
        """Return the camera of a crop of this one's picture: the rows from ``first`` to ``end`` (exclusive)."""
        return replace(self, height=end - first, cy=self.cy - first)

    def unproject(self, depth: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the world point of each pixel, float64 [height, width, 3] in metres, from planar ``depth``, float
        [height, width] in metres: the paper's "ProjectionEquation", with the camera centre added only once. A pixel
        without depth (0) gets the camera centre."""
        if depth.shape != (self.height, self.width):
            raise ValueError(f"depth is {depth.shape[1]}x{depth.shape[0]}, the camera {self.width}x{self.height}")
        return self.points(np.arange(self.width) + 0.5, np.arange(self.height)[:, None] + 0.5, depth)

    def points(self, u: NDArray[Any], v: NDArray[Any], depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return world points, float64 [..., 3] in metres, at pixel coordinates ``u``, ``v`` and ``depth`` (metres),
        which are floats and are broadcast."""
        d, x, y = depth.astype(np.float64), (u - self.cx) / self.fx, (v - self.cy) / self.fy
        if self.projection == "orthographic":
            local = np.stack(np.broadcast_arrays(x, y, d), axis=-1)
        elif self.projection == "equirectangular":
            local = np.stack([np.sin(x) * np.cos(y) * d, np.sin(y) * d, np.cos(x) * np.cos(y) * d], axis=-1)
        else:
            local = np.stack([x * d, y * d, d], axis=-1)
        return local @ self.camera_to_world[:3, :3].T + self.camera_to_world[:3, 3]

    def project(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project world points [..., 3] into the picture. Returns pixel coordinates (x, y), float64 [..., 2], and depth
        in metres, float64 [...]. Where depth <= 0 the coordinates are finite but meaningless."""
        local = (points - self.centre) @ self.camera_to_world[:3, :3]
        x, y, z = local[..., 0], local[..., 1], local[..., 2]
        if self.projection == "equirectangular":
            x, y, z = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z)), np.linalg.norm(local, axis=-1)
        elif self.projection == "perspective":
            safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
            x, y = x / safe, y / safe
        return np.stack([x * self.fx + self.cx, y * self.fy + self.cy], axis=-1), z

    def seen(self, points: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return which of the world points [N, 3] project into the picture, hidden ones included: their rows, int64
        [n], their pixel coordinates (x, y), float64 [n, 2], and their planar depth in metres, float64 [n]."""
        pixel, depth = self.project(points)
        rows = np.flatnonzero((depth > 0) & ((pixel >= 0) & (pixel < np.array(self.size))).all(axis=1))
        return rows, pixel[rows], depth[rows]


Size = tuple[int, int]  # (width, height) in pixels


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """The sparse points of the reconstruction (such as COLMAP's) that found a scene's poses. ``xyz`` floats [N, 3] in
    the same world as the poses, ``rgb`` uint8 [N, 3] sRGB. ``seen_by`` maps a frame's name to the indices, int64 [K],
    of the points found in its picture; it is empty in formats without tracks."""

    xyz: NDArray[np.floating]
    rgb: NDArray[np.uint8]
    seen_by: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.xyz)

    def turned(self, turn: NDArray[np.float64]) -> SparsePoints:
        """Return the points in a world rotated by ``turn``, float64 [3, 3]."""
        return SparsePoints(self.xyz @ turn.T, self.rgb, self.seen_by)


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """One picture and the camera that took it; ``held_out``: it tests the lift and does not train it. ``colour_path``
    and ``depth_path`` are the files of its pixels. ``file_shows_colour`` says that ``colour_path`` is an image of the
    frame as it is, not a video, an archive, or a picture that must be undistorted."""

    name: str
    camera: Camera
    held_out: bool
    colour_path: Path
    depth_path: Path | None
    file_shows_colour: bool = field(default=True, kw_only=True)

    @property
    def size(self) -> Size:
        return self.camera.width, self.camera.height


@dataclass(frozen=True, eq=False)
class PosedScene:
    """A scene's posed frames in recording order, the classes of its masks, and warnings for the user. ``folder`` is the
    folder or single file that the user named; ``format`` is the name of its reader. ``points`` are its
    reconstruction's, or None. ``turn``, float64 [3, 3], is the rotation that made z point up, or None. ``estimated``
    tells what was not measured."""

    folder: Path
    frames: tuple[PosedFrame, ...]
    classes: ClassTable
    warnings: tuple[str, ...] = ()
    format: str = "scannet"
    points: SparsePoints | None = None
    turn: NDArray[np.float64] | None = None
    estimated: tuple[str, ...] = ()


def size_within(size: Size, box: Size) -> Size:
    """Return ``size`` (width, height) reduced to fit into ``box`` with its aspect ratio kept; it is never enlarged."""
    width, height = size
    scale = min(1.0, box[0] / width, box[1] / height)
    return max(1, round(width * scale)), max(1, round(height * scale))
