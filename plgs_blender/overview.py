"""From where a room is best seen as a whole. Plain numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..engine.scene.camera import Camera

_ELEVATION = np.radians(42.0)
_FOCAL_WIDTHS = 1.45
"""Focal length in picture widths: a 52 mm lens, which keeps the walls nearly upright."""
_MARGIN = 0.88
_DIRECTIONS = 16
_STRAY = 0.05
"""Percent of the points that may lie outside."""
_ENOUGH = 100_000
"""So many points tell where to stand."""
_DEFAULT_ROOM = np.array([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.5]])


def overview_camera(
    xyz: NDArray[np.floating], normals: NDArray[np.floating], size: tuple[int, int] = (1280, 800)
) -> Camera:
    """A camera outside and above points [N, 3] in metres, with those in its picture that face it.

    It stands on the side from which most points do; `normals` [N, 3] are zero where that is unknown.
    """
    if not len(xyz):
        xyz, normals = _DEFAULT_ROOM, np.zeros_like(_DEFAULT_ROOM)
    step = 1 + len(xyz) // _ENOUGH
    xyz, normals = xyz[::step].astype(np.float64), normals[::step]
    axes = max(
        (_axes(2.0 * np.pi * step / _DIRECTIONS) for step in range(_DIRECTIONS)),
        key=lambda candidate: int(np.count_nonzero(normals @ candidate[:, 2] < -0.2)),
    )
    facing = normals @ axes[:, 2] <= 0.0
    return _framed(axes, xyz[facing] if facing.any() else xyz, size)


def _axes(azimuth: float) -> NDArray[np.float64]:
    """Right, down and forward of a camera that looks down at the room from an azimuth, columns of float64 [3,
    3].
    """
    flat = -np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = flat * np.cos(_ELEVATION) + np.array([0.0, 0.0, -np.sin(_ELEVATION)])
    right = np.array([flat[1], -flat[0], 0.0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _framed(axes: NDArray[np.float64], xyz: NDArray[np.float64], size: tuple[int, int]) -> Camera:
    """Move the camera back along its axis until the points just fit, and aside until they are centred."""
    width, height = size
    focal = _FOCAL_WIDTHS * width
    half = np.array([width, height]) / 2.0 * _MARGIN / focal
    local = xyz @ axes
    # A point at depth d is inside while |offset from the axis| <= half * d: the outermost points on either
    # side fix both where the axis runs and how far back the camera must be. A few stray ones must not count.
    right_most = np.percentile(local[:, :2] - half * local[:, 2:], 100.0 - _STRAY, axis=0)
    left_most = np.percentile(local[:, :2] + half * local[:, 2:], _STRAY, axis=0)
    back = float(((right_most - left_most) / (2.0 * half)).max())
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = axes @ [*((right_most + left_most) / 2.0), -back]
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose)
