"""Fuse rendered depth into one surface, by Open3D's truncated signed distance field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from ..job.progress import Progress, part_of, unwatched
from ..scene import Camera, Frame, watched

VOXEL = 0.02  # side of a voxel in metres
_STEP = 1.1  # the ratio of neighbouring depths above which two pixels belong to different surfaces
STRAIGHT = ((0.0, 4.0),)
GRAZED = (*STRAIGHT, (2.0, 8.0), (4.0, 12.0))
"""Slopes of a surface, and the number of voxels before and behind it, along the view's axis, that a view changes from
that slope on. A view that grazes a floor must reach farther; otherwise the floor has holes. The cost is that round
objects get thicker."""
_STRIDE = 4  # Open3D samples each fourth row and column for voxels, and raises an error if a view has none there
_SIDE = 8  # voxels along a block
MOST_BLOCKS = 3_000
"""Blocks of voxels in a slab. Each takes 18 KB, in the field and while its surface is found."""

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh: ``xyz`` float32 [V, 3] m, ``rgb`` uint8 [V, 3], ``normal`` float32 [V, 3], ``triangles`` int64 [T, 3]."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    normal: NDArray[np.float32]
    triangles: NDArray[np.int64]

    def of(self, triangles: Ints) -> tuple[Surface, Ints]:
        """Return the surface of ``triangles`` [T, 3] alone, and the old index of each of its vertices, [V]."""
        is_used = np.zeros(len(self.xyz), np.bool_)
        is_used[triangles] = True
        used, number = np.flatnonzero(is_used), np.cumsum(is_used) - 1
        return Surface(self.xyz[used], self.rgb[used], self.normal[used], number[triangles]), used


@dataclass(frozen=True)
class Grain:
    """How finely views are fused. ``voxel`` is the side of a voxel and ``farthest`` the largest depth that counts, both
    in metres. A voxel needs ``least_views`` views. Depth maps are first enlarged ``times`` times. ``reaches`` says how
    far depth acts around a surface by its slope (see `_by_slope`). Far floors need enlarged depth, and GRAZED."""

    voxel: float = VOXEL
    farthest: float = 8.0
    least_views: int = 2
    times: int = 1
    reaches: tuple[tuple[float, float], ...] = STRAIGHT


@dataclass(frozen=True, eq=False)
class SmallView:
    """A view, scaled down: ``depth`` float32 [H, W] m, ``rgb`` uint8 [H, W, 3], ``label`` int64 [H, W] (class *
    `mesh.MOST_INSTANCES` + instance); ``frame`` has the photo, None without textures."""

    camera: Camera
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    label: NDArray[np.int64]
    frame: Frame | None = None

    def large_depth(self, times: int) -> NDArray[np.float32]:
        """Return the depth enlarged to float32 [H * times, W * times], in metres. Within a surface, inverse depth is
        interpolated, which keeps planes flat."""
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
        """Return the inverse depth, float32 [H, W] in 1/m, 0 for none; and uint8 [H, W], 1 where a pixel and its
        neighbours are one surface."""
        inverse = np.divide(1.0, self.depth, out=np.zeros_like(self.depth), where=self.depth > 0)
        around = np.ones((3, 3), np.uint8)
        lowest, highest = cv2.erode(inverse, around), cv2.dilate(inverse, around)
        return inverse, ((lowest > 0) & (highest < _STEP * lowest)).astype(np.uint8)

    def slopes(self) -> NDArray[np.float32]:
        """Return each pixel's depth divided by the camera's distance from the plane of its surface, float32 [H, W]: 1
        for a frontal surface, larger for grazing views, 0 for edges and missing depth."""
        inverse, is_one = self._inverse
        down, right = np.gradient(inverse)
        row, column = np.indices(inverse.shape, np.float32) + np.float32(0.5)
        camera = self.camera
        ahead = inverse - right * (column - camera.cx) - down * (row - camera.cy)
        length = np.sqrt((right * camera.fx) ** 2 + (down * camera.fy) ** 2 + ahead**2)
        return np.divide(length, inverse, out=np.zeros_like(inverse), where=is_one > 0)


def fuse(views: Sequence[SmallView], grain: Grain = Grain(), progress: Progress = unwatched) -> Surface:
    """Return the surface on which the signed distances of all views are zero. It is fused slab by slab, so that memory
    does not grow with the room. Normals point towards the cameras."""
    finding, fusing = part_of(progress, 0.0, 0.2, 100), part_of(progress, 0.2, 0.9, 100)
    seen = [_blocks(view, grain) for view in watched(views, finding)]
    slabs = _slabs(np.concatenate([np.empty((0, 3), np.int32), *(each for found in seen for each in found)]))
    parts = [
        _fused(views, seen, slab, grain, part_of(fusing, number / len(slabs), (number + 1) / len(slabs), 100))
        for number, slab in enumerate(slabs)
    ]
    if not any(len(part.triangles) for part in parts):
        none = np.empty((0, 3), np.float32)
        return Surface(none, none.astype(np.uint8), none, none.astype(np.int64))
    before = np.cumsum([0, *(len(part.xyz) for part in parts)])
    triangles = np.concatenate([part.triangles + start for part, start in zip(parts, before, strict=False)])
    xyz, rgb, normal = (np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "rgb", "normal"))
    whole = _in_order(Surface(xyz, rgb, normal, triangles))
    progress(95, 100)
    return _smoothed(whole)


class _Slab(NamedTuple):
    """The blocks of voxels whose index along one axis is between ``first`` and ``last``."""

    axis: int
    first: int
    last: int


def _slabs(blocks: NDArray[np.int32]) -> list[_Slab]:
    """Cut blocks [N, 3], perhaps with duplicates, into slabs of about MOST_BLOCKS across their longest axis."""
    if not len(blocks):
        return []
    blocks = np.unique(blocks, axis=0)
    axis = int(np.argmax(np.ptp(blocks, axis=0)))
    low = int(blocks[:, axis].min())
    number = np.cumsum(np.bincount(blocks[:, axis] - low)) // MOST_BLOCKS
    firsts = low + np.flatnonzero(np.diff(number, prepend=-1))
    return [_Slab(axis, *ends) for ends in zip(firsts, [*(firsts[1:] - 1), low + len(number) - 1], strict=True)]


class _Lens:
    """A view's camera in Open3D's form, for its enlarged depth and for its colours."""

    def __init__(self, view: SmallView, times: int) -> None:
        import open3d.core

        height, width = view.depth.shape
        matrices = view.camera.resized(times * width, times * height).K, view.camera.K
        pose = np.linalg.inv(view.camera.camera_to_world)
        self.large, self.small, self.pose = map(open3d.core.Tensor.from_numpy, (*matrices, pose))


def _grid(voxel: float, blocks: int) -> Any:
    """Return an empty voxel grid with memory for ``blocks``; Open3D takes more when it needs it."""
    import open3d.core
    import open3d.t.geometry as geometry

    names, kinds = ("tsdf", "weight", "color"), (open3d.core.float32,) * 3
    return geometry.VoxelBlockGrid(names, kinds, ((1), (1), (3)), voxel, _SIDE, blocks)


def _blocks(view: SmallView, grain: Grain) -> list[NDArray[np.int32]]:
    """Return the blocks [N, 3] that the view's depth changes, for each range of slopes (`_by_slope`)."""
    import open3d.t.geometry as geometry

    lens, grid, found = _Lens(view, grain.times), _grid(grain.voxel, 1), []
    for part, reach in _by_slope(view, view.large_depth(grain.times), grain):
        blocks = np.empty((0, 3), np.int32)
        if part[::_STRIDE, ::_STRIDE].any():
            seen = lens.large, lens.pose, 1.0, grain.farthest, reach  # 1.0: metres
            blocks = grid.compute_unique_block_coordinates(geometry.Image(part), *seen).numpy()
        found.append(blocks)
    return found


def _fused(
    views: Sequence[SmallView], seen: Sequence[Sequence[NDArray[np.int32]]], slab: _Slab, grain: Grain,
    progress: Progress,
) -> Surface:  # fmt: skip
    """Fuse the views within a slab, and return the surface in it. ``seen`` are the blocks that each view changes.
    Blocks beside the slab are fused, too, as its outermost voxels need them."""
    import open3d.core
    import open3d.t.geometry as geometry

    grid, steps = _grid(grain.voxel, 2 * MOST_BLOCKS), len(views) + 1  # with those beside the slab
    for number, (view, found) in enumerate(zip(views, seen, strict=True)):
        progress(number, steps)
        within = [(each[:, slab.axis] >= slab.first - 1) & (each[:, slab.axis] <= slab.last + 1) for each in found]
        if not any(each.any() for each in within):
            continue
        lens, colour = _Lens(view, grain.times), geometry.Image(view.rgb / np.float32(255))
        parts = _by_slope(view, view.large_depth(grain.times), grain)
        for (part, reach), blocks, inside in zip(parts, found, within, strict=True):
            if inside.any():
                own = open3d.core.Tensor.from_numpy(np.ascontiguousarray(blocks[inside]))
                how = lens.large, lens.small, lens.pose, 1.0, grain.farthest, reach
                grid.integrate(own, geometry.Image(part), colour, *how)
    mesh = grid.extract_triangle_mesh(grain.least_views - 0.5)  # more than this weight, and each view weighs 1
    progress(steps, steps)
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
        none = np.empty((0, 3), np.float32)
        return Surface(none, none.astype(np.uint8), none, none.astype(np.int64))
    arrays = (mesh.vertex[name].numpy() for name in ("positions", "colors", "normals"))
    xyz, rgb, normal = arrays
    triangles = mesh.triangle.indices.numpy().astype(np.int64)
    middle = xyz[triangles, slab.axis].mean(axis=1, dtype=np.float64)
    block = np.floor(middle / (_SIDE * grain.voxel))
    triangles = triangles[(block >= slab.first) & (block <= slab.last)]
    colours = np.rint(255 * rgb.clip(0, 1)).astype(np.uint8)
    return Surface(xyz.copy(), colours, normal.copy(), triangles).of(triangles)[0]


def triangle_normals(xyz: NDArray[np.float32], triangles: Ints) -> NDArray[np.float64]:
    """Return the normals of ``triangles`` [T, 3], each as long as twice its area, float64 [T, 3]."""
    a, b, c = xyz[triangles].astype(np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def neighbours(triangles: Ints, count: int) -> csr_matrix:
    """Return which of ``count`` vertices share an edge of a triangle [T, 3], bool [count, count]."""
    first, last = (triangles[:, corner].astype(np.int32).ravel() for corner in ((0, 1, 2), (1, 2, 0)))
    one_way = coo_matrix((np.ones(len(first), np.bool_), (first, last)), (count, count)).tocsr()
    return one_way + one_way.T


def _smoothed(surface: Surface) -> Surface:
    """Return the surface with each vertex moved to the mean of itself and its neighbours. Open3D's vertices lie on the
    edges of the grid, which leaves steps where views graze: the mean is nearer to the true surface."""
    beside = neighbours(surface.triangles, len(surface.xyz)).astype(np.float32)
    size = np.asarray(beside.sum(axis=1)) + 1
    xyz, rgb, normal = (
        (values + beside @ values.astype(np.float64)) / size for values in (surface.xyz, surface.rgb, surface.normal)
    )
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    colours = np.rint(rgb).astype(np.uint8)
    return Surface(xyz.astype(np.float32), colours, normal.astype(np.float32), surface.triangles)


def _by_slope(view: SmallView, large: NDArray[np.float32], grain: Grain) -> Iterator[tuple[NDArray[np.float32], float]]:
    """Split the ``large`` depth [H, W] by slope. Yields each part and the number of voxels that it reaches."""
    if len(grain.reaches) == 1:
        yield np.where(large <= grain.farthest, large, np.float32(0)), grain.reaches[0][1]
        return
    slope = cv2.resize(view.slopes(), large.shape[::-1], None, 0, 0, cv2.INTER_NEAREST)
    for (least, reach), (most, _) in pairwise((*grain.reaches, (np.inf, 0.0))):
        part = np.where((slope >= least) & (slope < most) & (large <= grain.farthest), large, np.float32(0))
        yield part, reach


def _in_order(surface: Surface) -> Surface:
    """Return the same surface with sorted vertices and triangles, as Open3D's threads return them in a varying order.
    Duplicate vertices, which Open3D leaves between blocks of voxels, are merged."""
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
