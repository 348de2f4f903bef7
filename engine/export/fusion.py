"""Rendered depth fused into one surface, by Open3D's truncated signed distance field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene import Camera, Frame

VOXEL = 0.02  # side of a voxel in metres
_STEP = 1.1  # the ratio of neighbouring depths above which two pixels belong to different surfaces
STRAIGHT = ((0.0, 4.0),)
GRAZED = (*STRAIGHT, (2.0, 8.0), (4.0, 12.0))
"""Slopes of a surface, and the number of voxels before and behind it, along the view's axis, that a view changes from
that slope on. A view that grazes a floor must reach farther; otherwise the floor has holes. The cost is that round
objects get thicker."""
_STRIDE = 4  # Open3D looks for voxels at every fourth row and column, and refuses views that show none there
_BLOCKS = 20_000  # the blocks of voxels for which memory is reserved at first; Open3D takes more when it needs them

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Surface:
    """``xyz`` float32 [V, 3] m, ``rgb`` uint8 [V, 3], ``normal`` float32 [V, 3], ``triangles`` int64 [T, 3]."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    normal: NDArray[np.float32]
    triangles: NDArray[np.int64]

    def of(self, triangles: Ints) -> tuple[Surface, Ints]:
        """The surface with only these of its triangles [T, 3], and which of its vertices they use, [V]."""
        is_used = np.zeros(len(self.xyz), np.bool_)
        is_used[triangles] = True
        used, number = np.flatnonzero(is_used), np.cumsum(is_used) - 1
        return Surface(self.xyz[used], self.rgb[used], self.normal[used], number[triangles]), used


@dataclass(frozen=True)
class Grain:
    """How views are fused: the side of a ``voxel`` in metres, the maximum depth in metres, how many views must see a
    voxel, the enlargement of the views' depth, and their reach. Far floors need depth between pixels, and GRAZED."""

    voxel: float = VOXEL
    farthest: float = 8.0
    least_views: int = 2
    times: int = 1
    reaches: tuple[tuple[float, float], ...] = STRAIGHT


@dataclass(frozen=True, eq=False)
class SmallView:
    """``depth`` float32 [H, W] m, ``rgb`` uint8 [H, W, 3], ``label`` int64 [H, W], and the ``frame`` of the photo."""

    camera: Camera
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    label: NDArray[np.int64]
    frame: Frame | None = None

    def large_depth(self, times: int) -> NDArray[np.float32]:
        """The enlarged depth, float32 [H * times, W * times], in metres. On one surface, inverse depth is interpolated,
        in which planes are flat."""
        if times == 1:
            return np.ascontiguousarray(self.depth)
        inverse, is_one = self._inverse
        is_inside = cv2.resize(is_one, None, None, times, times, cv2.INTER_NEAREST) > 0
        large, blocky = (cv2.resize(inverse, None, None, times, times, how)
                         for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST))  # fmt: skip
        large = np.where(is_inside, large, blocky)
        return np.divide(1.0, large, out=np.zeros_like(large), where=large > 0)

    @cached_property
    def _inverse(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The inverse depth [H, W] 1/m, 0 for none; and uint8 [H, W], 1 where a pixel's neighbours are one surface."""
        inverse = np.divide(1.0, self.depth, out=np.zeros_like(self.depth), where=self.depth > 0)
        around = np.ones((3, 3), np.uint8)
        lowest, highest = cv2.erode(inverse, around), cv2.dilate(inverse, around)
        return inverse, ((lowest > 0) & (highest < _STEP * lowest)).astype(np.uint8)

    def slopes(self) -> NDArray[np.float32]:
        """The depth divided by the camera's distance from the plane of each pixel's surface, float32 [H, W]: 1 for a
        frontal surface, larger for grazing views, 0 for edges and missing depth."""
        inverse, is_one = self._inverse
        down, right = np.gradient(inverse)
        row, column = np.indices(inverse.shape, np.float32) + np.float32(0.5)
        camera = self.camera
        ahead = inverse - right * (column - camera.cx) - down * (row - camera.cy)
        length = np.sqrt((right * camera.fx) ** 2 + (down * camera.fy) ** 2 + ahead**2)
        return np.divide(length, inverse, out=np.zeros_like(inverse), where=is_one > 0)


def fuse(views: Sequence[SmallView], grain: Grain = Grain()) -> Surface:
    """The zero level of the field of all views. Normals point towards the cameras."""
    import open3d.core
    import open3d.t.geometry as geometry

    names, kinds = ("tsdf", "weight", "color"), (open3d.core.float32,) * 3
    grid = geometry.VoxelBlockGrid(names, kinds, ((1), (1), (3)), grain.voxel, 8, _BLOCKS)  # 8 along a block
    for view in views:
        large = view.large_depth(grain.times)
        colour = geometry.Image(view.rgb / np.float32(255))
        lenses = view.camera.resized(*large.shape[::-1]).K, view.camera.K
        to_camera = np.linalg.inv(view.camera.camera_to_world)
        lens, small_lens, pose = map(open3d.core.Tensor.from_numpy, (*lenses, to_camera))
        for part, reach in _by_slope(view, large, grain):
            if not part[::_STRIDE, ::_STRIDE].any():
                continue
            depth = geometry.Image(part)
            blocks = grid.compute_unique_block_coordinates(depth, lens, pose, 1.0, grain.farthest, reach)  # 1.0: metres
            grid.integrate(blocks, depth, colour, lens, small_lens, pose, 1.0, grain.farthest, reach)
    if not grid.hashmap().size():
        none = np.empty((0, 3), np.float32)
        return Surface(none, none.astype(np.uint8), none, none.astype(np.int64))
    # Open3D needs more than this weight, and each view weighs 1. Its vertices lie on the edges of the grid, so grazing
    # views leave steps: one round of smoothing brings the vertices nearer to the true surface.
    mesh = grid.extract_triangle_mesh(grain.least_views - 0.5).to_legacy().filter_smooth_simple(1).normalize_normals()
    xyz, normal, rgb = (np.asarray(each) for each in (mesh.vertices, mesh.vertex_normals, mesh.vertex_colors))
    colour, triangles = np.rint(255 * rgb.clip(0, 1)).astype(np.uint8), np.asarray(mesh.triangles).astype(np.int64)
    return _in_order(Surface(xyz.astype(np.float32), colour, normal.astype(np.float32), triangles))


def _by_slope(view: SmallView, large: NDArray[np.float32], grain: Grain) -> Iterator[tuple[NDArray[np.float32], float]]:
    """The ``large`` depth [H, W], split by slope, with the number of voxels that each slope reaches."""
    if len(grain.reaches) == 1:
        yield np.where(large <= grain.farthest, large, np.float32(0)), grain.reaches[0][1]
        return
    slope = cv2.resize(view.slopes(), large.shape[::-1], None, 0, 0, cv2.INTER_NEAREST)
    for (least, reach), (most, _) in pairwise((*grain.reaches, (np.inf, 0.0))):
        part = np.where((slope >= least) & (slope < most) & (large <= grain.farthest), large, np.float32(0))
        yield part, reach


def _in_order(surface: Surface) -> Surface:
    """The same surface with sorted vertices and triangles, as Open3D's threads return them in a varying order.
    Duplicate vertices, which it leaves between blocks of voxels, are merged."""
    order = np.lexsort(np.concatenate([surface.normal, surface.xyz], axis=1).T)
    xyz = surface.xyz[order]
    is_first = np.ones(len(xyz), bool)
    is_first[1:] = (xyz[1:] != xyz[:-1]).any(axis=1)
    number = np.empty_like(order)
    number[order] = np.cumsum(is_first) - 1
    triangles = number[surface.triangles]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    first = triangles.argmin(axis=1)[:, None]
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)  # rotated, which keeps normals
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    kept = order[is_first]
    return Surface(surface.xyz[kept], surface.rgb[kept], surface.normal[kept], triangles)
