"""A coloured cloud of the frames' depth, in one pass over the frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera

_CELLS_DEEP = 200.0
"""The number of cells in the median depth of the first frame: a cell is about a centimetre in a room."""
_SIDE = 2**20
"""Cells along an axis, from -_SIDE to _SIDE."""


@dataclass(frozen=True, eq=False)
class ColouredCloud:
    """``xyz`` float32 [N, 3] world metres, ``rgb`` uint8 [N, 3] sRGB."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]


class CloudBuilder:
    """Collects pixels in cells of a grid; a cell becomes one point, the mean of its pixels.

    When more than ``cap`` cells are taken, every eight of them become one, so that memory stays bounded.
    """

    def __init__(self, cap: int = 400_000) -> None:
        self._cap, self._spacing = cap, 0.0
        self._cells = np.zeros((0, 3), np.int64)
        self._sums = np.zeros((0, 7))  # x y z r g b count

    def add(self, camera: Camera, depth: NDArray[np.float32], colour: NDArray[np.uint8], stride: int = 1) -> None:
        """Add a frame: depth float32 [H, W] metres (0 = none) and colour uint8 [H, W, 3], of ``camera``'s size. Every
        ``stride``-th row and column is taken.
        """
        seen = depth[::stride, ::stride] > 0.0
        xyz = camera.unproject(depth)[::stride, ::stride][seen]
        if not len(xyz):
            return
        if not self._spacing:
            self._spacing = float(np.median(depth[depth > 0.0])) / _CELLS_DEEP
        cells = np.clip(np.floor(xyz / self._spacing), -_SIDE, _SIDE - 1).astype(np.int64)
        sums = np.concatenate([xyz, colour[::stride, ::stride][seen], np.ones((len(xyz), 1))], axis=1)
        self._merge(np.concatenate([self._cells, cells]), np.concatenate([self._sums, sums]))
        while len(self._cells) > self._cap:
            self._spacing *= 2.0
            self._merge(self._cells // 2, self._sums)

    def cloud(self) -> ColouredCloud:
        """The cloud of all frames so far."""
        mean = self._sums[:, :6] / np.maximum(self._sums[:, 6:], 1.0)
        return ColouredCloud(mean[:, :3].astype(np.float32), np.rint(mean[:, 3:]).astype(np.uint8))

    def _merge(self, cells: NDArray[np.int64], sums: NDArray[np.float64]) -> None:
        """Keep one row per cell, in the order of the cells."""
        x, y, z = (cells + _SIDE).T
        _, first, cell = np.unique((x * 2 * _SIDE + y) * 2 * _SIDE + z, return_index=True, return_inverse=True)
        self._cells = cells[first]
        columns = [np.bincount(cell.ravel(), column, len(first)) for column in sums.T]
        self._sums = np.stack(columns, axis=1)
