"""Which way each point of a scanned room faces: what lets us look into it from outside. Plain numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_TOUCHING = 0.75
"""Radius in spacings: somewhat over a half, since points are not evenly spread."""
_NEIGHBOURHOOD = 4.0
"""Side of the cells in which planes are fitted, in point spacings."""


def point_spacing(xyz: NDArray[np.floating]) -> float:
    """Typical distance between neighbours of points float [N, 3] on surfaces, in their unit; 0 for fewer than
    2 points.

    Counts the cells that the surfaces cross instead of measuring distances, so that millions take a blink.
    """
    if len(xyz) < 2:
        return 0.0
    extent = float((xyz.max(axis=0) - xyz.min(axis=0)).max())
    if extent == 0.0:
        return 0.0
    # Cells that hold about a dozen points each: fine enough to follow surfaces, coarse enough to have no gaps.
    side = extent / max(1.0, np.sqrt(len(xyz) / 24.0))
    occupied = len(np.unique(_cell_numbers(xyz, side)))
    return side * float(np.sqrt(occupied / len(xyz)))


def point_radii(xyz: NDArray[np.floating], smallest: float, largest: float) -> NDArray[np.float32]:
    """Radii float32 [N] with which points [N, 3] on surfaces just touch, denser where they lie denser; all in
    metres.
    """
    spacing = point_spacing(xyz)
    if spacing == 0.0:
        return np.full(len(xyz), smallest, np.float32)
    side = spacing * _NEIGHBOURHOOD
    _, cell, count = np.unique(_cell_numbers(xyz, side), return_inverse=True, return_counts=True)
    # A surface crosses a cell with about its face's area. Cells that it only grazes have few points.
    local = np.minimum(side / np.sqrt(count[cell.ravel()]), 2.0 * spacing)
    return np.clip(_TOUCHING * local, smallest, largest).astype(np.float32)


def point_normals(xyz: NDArray[np.floating], viewpoints: NDArray[np.floating]) -> NDArray[np.float32]:
    """Unit normals float32 [N, 3] of surface points [N, 3] seen from viewpoints [V, 3]; zeros when there are
    none.

    Fits a plane to the points of each cell and turns it towards the nearest viewpoint: scanned surfaces face
    their cameras. Where there is no plane, the direction to that viewpoint stands for it. Coarse, but a
    wall's outside is told from its inside.
    """
    normals = np.zeros((len(xyz), 3), np.float32)
    spacing = point_spacing(xyz)
    if spacing == 0.0 or not len(viewpoints):
        return normals
    _, cell = np.unique(_cell_numbers(xyz, spacing * _NEIGHBOURHOOD), return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell).astype(np.float64)
    # Sums of squares lose digits far from the origin.
    local = xyz.astype(np.float64) - xyz.mean(axis=0)
    mean = np.stack([np.bincount(cell, local[:, axis]) for axis in range(3)], axis=1) / count[:, None]
    spread = np.empty((len(count), 3, 3))
    for row in range(3):
        for column in range(row, 3):
            product = np.bincount(cell, local[:, row] * local[:, column]) / count
            spread[:, row, column] = spread[:, column, row] = product - mean[:, row] * mean[:, column]
    lengths, axes = np.linalg.eigh(spread)
    plane = axes[:, :, 0]
    towards = _towards_nearest(mean + xyz.mean(axis=0), viewpoints)
    plane *= np.where(np.einsum("ij,ij->i", plane, towards) < 0.0, -1.0, 1.0)[:, None]
    no_plane = (count < 4) | (lengths[:, 0] > 0.3 * lengths[:, 1])
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    plane[no_plane] = (towards / np.maximum(distance, 1e-9))[no_plane]
    return plane[cell].astype(np.float32)


def _towards_nearest(points: NDArray[np.float64], viewpoints: NDArray[np.floating]) -> NDArray[np.float64]:
    """Vectors [N, 3] from each point to its nearest viewpoint."""
    nearest = np.full(len(points), np.inf)
    towards = np.zeros_like(points)
    for viewpoint in viewpoints:
        offset = viewpoint - points
        distance = np.einsum("ij,ij->i", offset, offset)
        closer = distance < nearest
        nearest[closer], towards[closer] = distance[closer], offset[closer]
    return towards


def _cell_numbers(xyz: NDArray[np.floating], side: float) -> NDArray[np.int64]:
    """One number per point [N]: equal numbers, same cell of a grid with this side."""
    cells = np.floor((xyz - xyz.min(axis=0)) / side).astype(np.int64)
    size = cells.max(axis=0) + 1
    return (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
