"""Depth maps fused into one surface: a truncated signed distance field, and the surface where it is zero.

Voxels are kept in blocks around what was seen. The surface has a vertex a cell that it crosses, in the middle of its
crossings with the cell's edges (naive surface nets), so its triangles are even and there are no tables of cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera

VOXEL = 0.02
"""Side of a voxel in metres."""
TRUNCATION = 4.0 * VOXEL
"""Metres on each side of the surface that a view changes."""
FARTHEST = 8.0
"""Metres beyond which rendered depth is not fused."""
LEAST_VIEWS = 2
"""Views that a voxel needs."""
_SIDE = 8
"""Voxels along a block's side."""
_VOXELS = _SIDE**3
_AT_ONCE = 1000
"""Blocks that are worked on at once."""
_RANGE = 1 << 20
"""Coordinates of voxels are within this, to both sides."""
_CORNERS = np.array(list(product((0, 1), repeat=3)), np.int64)
"""The corners of a cell; bits of the number are x, y, z from the highest down."""
_EDGES = [(i, i | bit) for i in range(8) for bit in (4, 2, 1) if not i & bit]

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Surface:
    """``xyz`` float32 [V, 3] m, ``rgb`` uint8 [V, 3], ``normal`` float32 [V, 3], ``triangles`` int64 [T, 3]."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    normal: NDArray[np.float32]
    triangles: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SmallView:
    """A view as it is fused: ``depth`` float32 [H, W] m, ``rgb`` uint8 [H, W, 3], ``label`` int64 [H, W]."""

    camera: Camera
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    label: NDArray[np.int64]


def fuse(views: Sequence[SmallView]) -> Surface:
    """The zero level of the field of all views. Normals point to where the cameras are."""
    seen = [_blocks_near(view) for view in views]
    keys = np.unique(np.concatenate([np.empty(0, np.int64), *seen]))
    field = _Field(keys)
    for view, own in zip(views, seen, strict=True):
        field.add(view, np.searchsorted(keys, own))
    return field.surface()


class _Field:
    """Distances (of TRUNCATION, positive towards the cameras), weights and colours of the voxels of all blocks."""

    def __init__(self, keys: Ints) -> None:
        self.keys, self.blocks = keys, _coordinates(keys)
        self.distance = np.zeros(len(keys) * _VOXELS, np.float32)
        self.weight = np.zeros(len(keys) * _VOXELS, np.uint16)
        self.rgb = np.zeros((len(keys) * _VOXELS, 3), np.float32)

    def add(self, view: SmallView, blocks: Ints) -> None:
        """Average a view into these blocks: indices [B]."""
        local = np.stack(np.unravel_index(np.arange(_VOXELS), (_SIDE,) * 3), axis=-1)
        for start in range(0, len(blocks), _AT_ONCE):
            some = blocks[start : start + _AT_ONCE]
            voxel = (some[:, None] * _VOXELS + np.arange(_VOXELS)).ravel()
            xyz = ((self.blocks[some, None] * _SIDE + local) * VOXEL).reshape(-1, 3)
            pixel, z = view.camera.project(xyz)
            height, width = view.depth.shape
            with np.errstate(invalid="ignore"):
                inside = (z > 0) & (pixel >= 0).all(axis=1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
            column, row = pixel[inside].astype(np.int64).T
            depth = view.depth[row, column]
            distance = (depth - z[inside]) / TRUNCATION
            holds = (depth > 0) & (depth <= FARTHEST) & (distance > -1)
            voxel, row, column = voxel[inside][holds], row[holds], column[holds]
            self.weight[voxel] += 1
            share = 1 / self.weight[voxel].astype(np.float32)
            self.distance[voxel] += share * (np.minimum(distance[holds], 1) - self.distance[voxel])
            self.rgb[voxel] += share[:, None] * (view.rgb[row, column] - self.rgb[voxel])

    def surface(self) -> Surface:
        parts = [self._cells(start) for start in range(0, len(self.keys), _AT_ONCE)]
        cell = np.concatenate([np.empty((0, 3), np.int64), *(cell for cell, _ in parts)])
        corner = np.concatenate([np.empty((0, 8), np.int64), *(corner for _, corner in parts)])
        keys = _keys(cell)
        order = np.argsort(keys)
        keys, cell, corner = keys[order], cell[order], corner[order]
        distance = self.distance[corner]
        xyz, rgb = self._vertices(cell, corner, distance)
        triangles = _triangles(keys, cell, distance)
        used, corners = np.unique(triangles, return_inverse=True)
        normal = _gradient(distance[used])
        return Surface(xyz[used], rgb[used], normal, corners.reshape(-1, 3).astype(np.int64))

    def _cells(self, start: int) -> tuple[Ints, Ints]:
        """The cells that the surface crosses, of some blocks: their places [M, 3] and their corners' voxels [M, 8]."""
        blocks = self.blocks[start : start + _AT_ONCE]
        voxel = np.full((len(blocks), *(_SIDE + 1,) * 3), -1, np.int64)  # with the first of the blocks behind
        own = np.arange(_VOXELS).reshape((_SIDE,) * 3)
        for step in _CORNERS:
            number, is_there = _found(self.keys, _keys(blocks + step))
            into = tuple(slice(_SIDE, None) if one else slice(_SIDE) for one in step)
            out_of = tuple(slice(1) if one else slice(None) for one in step)
            found = number[:, None, None, None] * _VOXELS + own[out_of]
            is_known = is_there[:, None, None, None] & (self.weight[found] >= LEAST_VIEWS)
            voxel[(slice(None), *into)] = np.where(is_known, found, -1)
        sides = [voxel[:, x : x + _SIDE, y : y + _SIDE, z : z + _SIDE] for x, y, z in _CORNERS]
        is_whole = np.logical_and.reduce([side >= 0 for side in sides])
        behind = [self.distance[side] < 0 for side in sides]
        crosses = is_whole & np.logical_or.reduce(behind) & ~np.logical_and.reduce(behind)
        block, *local = np.nonzero(crosses)
        return blocks[block] * _SIDE + np.stack(local, axis=-1), np.stack([side[crosses] for side in sides], axis=-1)

    def _vertices(self, cell: Ints, corner: Ints, distance: Floats) -> tuple[Floats, NDArray[np.uint8]]:
        """The middle of the crossings with each cell's edges, xyz [M, 3], and the colour there."""
        place, colour = np.zeros((len(cell), 3)), np.zeros((len(cell), 3))
        count = np.zeros((len(cell), 1))
        for i, j in _EDGES:
            at = np.flatnonzero((distance[:, i] < 0) != (distance[:, j] < 0))
            share = (distance[at, i] / (distance[at, i] - distance[at, j]))[:, None]
            place[at] += _CORNERS[i] + share * (_CORNERS[j] - _CORNERS[i])
            colour[at] += (1 - share) * self.rgb[corner[at, i]] + share * self.rgb[corner[at, j]]
            count[at] += 1
        xyz = (cell + place / count) * VOXEL
        return xyz.astype(np.float32), np.rint(np.clip(colour / count, 0, 255)).astype(np.uint8)


def _triangles(keys: Ints, cell: Ints, distance: Floats) -> Ints:
    """Two triangles [T, 3] for each edge of the grid that the surface crosses: between the four cells around it.
    ``keys`` ascend."""
    found = [np.empty((0, 3), np.int64)]
    for axis in range(3):
        ahead = distance[:, 4 >> axis] >= 0
        edges = np.flatnonzero((distance[:, 0] >= 0) != ahead)
        second, third = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        around = [_found(keys, _keys(cell[edges] - step)) for step in (0 * second, second, second + third, third)]
        is_there = np.logical_and.reduce([there for _, there in around])
        quad = np.stack([number for number, _ in around], axis=-1)[is_there]
        quad = np.where(ahead[edges][is_there, None], quad, quad[:, ::-1])
        found += [quad[:, (0, 1, 2)], quad[:, (0, 2, 3)]]
    return np.concatenate(found)


def _gradient(distance: Floats) -> Floats:
    """Unit normals [M, 3]: where the distances [M, 8] of a cell's corners rise."""
    up = distance @ (2 * _CORNERS - 1).astype(np.float32)
    length = np.linalg.norm(up, axis=1, keepdims=True)
    return np.divide(up, length, out=np.zeros_like(up), where=length > 0)


def _blocks_near(view: SmallView) -> Ints:
    """The keys of the blocks within TRUNCATION of what a view shows."""
    camera = view.camera
    row, column = np.nonzero((view.depth > 0) & (view.depth <= FARTHEST))
    z = view.depth[row, column].astype(np.float64)
    x = (column + 0.5 - camera.cx) / camera.fx * z
    y = (row + 0.5 - camera.cy) / camera.fy * z
    xyz = np.stack([x, y, z], axis=-1) @ camera.camera_to_world[:3, :3].T + camera.camera_to_world[:3, 3]
    coarse = _coordinates(np.unique(_keys(np.floor(xyz / TRUNCATION).astype(np.int64))))
    reach = [coarse + step for step in product((-1, 0, 1), repeat=3)]
    near = np.floor((np.concatenate(reach) + 0.5) * (TRUNCATION / (VOXEL * _SIDE))).astype(np.int64)
    return np.unique(_keys(near))


def _keys(places: Ints) -> Ints:
    """One number for each place [N, 3]; it ascends as x, y, z do."""
    x, y, z = (places + _RANGE).T
    return (x << 42) | (y << 21) | z


def _coordinates(keys: Ints) -> Ints:
    mask = 2 * _RANGE - 1
    return np.stack([keys >> 42, keys >> 21 & mask, keys & mask], axis=-1) - _RANGE


def _found(keys: Ints, wanted: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Where each wanted key stands among the ascending ones, and whether it is there; 0 where it is not."""
    place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    is_there = keys[place] == wanted if len(keys) else np.zeros(len(wanted), np.bool_)
    return np.where(is_there, place, 0), is_there
