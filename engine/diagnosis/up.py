"""Which way is up? Floors, ceilings and table tops say so: their normals, about the cameras' own up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .reprojection import Assumption, Floats, Views

_CLEARLY_UP = 0.6
_CONES = (40.0, 25.0, 15.0, 8.0, 5.0, 5.0, 5.0)
"""Degrees about the axis within which normals count, from the cameras' up to that of the surfaces."""
_LEAST_SHARE = 0.08
_LEVEL = 5.0
"""Degrees: normals this close to the axis are level surfaces', and this close to a right angle walls'."""


class UpAxis(NamedTuple):
    """``axis`` float64 [3]: up in the scene's world, a unit vector. ``tilt``: degrees between it and z.

    ``level`` and ``walls``: the shares of normals along the axis, and at right angles to it. ``deviation``: standard
    error of the axis in degrees. ``normals`` float64 [N, 3] are those that it was measured with.
    """

    axis: Floats
    tilt: float
    level: float
    walls: float
    deviation: float
    normals: Floats


def measure_up(views: Views, assumed: Assumption) -> UpAxis | None:
    """Up as the surfaces have it; None where cameras lie on their sides, or where few surfaces are level."""
    poses = views.poses_of(assumed)
    held = -poses[:, :3, 1].mean(0)
    if np.linalg.norm(held) < _CLEARLY_UP:
        return None
    normals, frames = world_normals(views, assumed)
    axis = held / np.linalg.norm(held)
    for cone in _CONES:
        near = np.abs(normals @ axis) > np.cos(np.radians(cone))
        if near.sum() < _LEAST_SHARE * len(normals):
            return None
        signed = normals[near] * np.sign(normals[near] @ axis)[:, None]
        axis = signed.mean(0) / np.linalg.norm(signed.mean(0))
    means = np.stack([signed[frames[near] == frame].mean(0) for frame in np.unique(frames[near])])
    scatter = np.linalg.norm(means - axis, axis=1)
    cosine = np.abs(normals @ axis)
    return UpAxis(
        axis=axis,
        tilt=float(np.degrees(np.arccos(np.clip(axis[2], -1.0, 1.0)))),
        level=float((cosine > np.cos(np.radians(_LEVEL))).mean()),
        walls=float((cosine < np.sin(np.radians(_LEVEL))).mean()),
        deviation=float(np.degrees(np.sqrt((scatter**2).mean() / len(means)))),
        normals=normals,
    )


def world_normals(views: Views, assumed: Assumption) -> tuple[Floats, NDArray[np.int64]]:
    """Normals of the looks' points in the world, float64 [N, 3], and the look that each is of, int64 [N]."""
    lens, poses = views.lens_of(assumed), views.poses_of(assumed)
    world, known = views.world_points(assumed, lens, poses)
    normals, frames = [], []
    for row in range(len(views.looks)):
        local = (world[row][known[row]] - poses[row, :3, 3]) @ poses[row, :3, :3]
        surface = views.surface_at(row, local, assumed, lens[row])
        good = np.isfinite(surface.distance)
        normals.append(surface.normal[good] @ poses[row, :3, :3].T)
        frames.append(np.full(int(good.sum()), row))
    return np.concatenate(normals), np.concatenate(frames)
