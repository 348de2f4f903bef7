"""Find which way is up: most normals of floors, ceilings and table tops point along it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .findings import MEND, Finding, level_surfaces
from .reprojection import Assumption, Examined, Floats, Views, lens_under

_CLEARLY_UP = 0.6
_CONES = (40.0, 25.0, 15.0, 8.0, 5.0, 5.0, 5.0)  # degrees about the axis within which normals count, round by round
_LEAST_SHARE = 0.08
_LEVEL = 5.0  # degrees; normals this close to the axis are of level surfaces, and this close to a right angle of walls
_TILTED, _CERTAIN = 5.0, 5.0  # degrees, standard errors; floors and scanners' worlds are level to within a degree
_NAMED_WITHIN = 8.0  # an axis of the poses within this many degrees is named
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class UpAxis(NamedTuple):
    """The direction of up. ``axis`` float64 [3] is up in the scene's world, ``tilt`` the degrees between it and z.
    ``level`` and ``walls`` are the fractions of normals along it and at right angles to it. ``deviation`` is its
    standard error in degrees."""

    axis: Floats
    tilt: float
    level: float
    walls: float
    deviation: float


def measure_tilt(views: Views, assumed: Assumption) -> UpAxis | None:
    """Find the up axis. None if it does not clearly differ from z, or if surfaces or cameras do not show it."""
    held = -views.poses_of(assumed)[:, :3, 1].mean(0)  # pictures' y is down, and most are taken upright
    if np.linalg.norm(held) < _CLEARLY_UP:
        return None
    by_look = world_normals(views, assumed)
    normals = np.concatenate([normals[known] for normals, known in by_look])
    frames = np.repeat(np.arange(len(by_look)), [known.sum() for _, known in by_look])
    axis = held / np.linalg.norm(held)
    for cone in _CONES:
        near = np.abs(normals @ axis) > np.cos(np.radians(cone))
        if near.sum() < max(_LEAST_SHARE * len(normals), 3):
            return None
        signed = normals[near] * np.sign(normals[near] @ axis)[:, None]  # ceilings count like floors
        axis = signed.mean(0) / np.linalg.norm(signed.mean(0))
    means = np.stack([signed[frames[near] == frame].mean(0) for frame in np.unique(frames[near])])
    scatter = np.linalg.norm(means - axis, axis=1)
    cosine = np.abs(normals @ axis)
    up = UpAxis(
        axis=axis,
        tilt=float(np.degrees(np.arccos(np.clip(axis[2], -1.0, 1.0)))),  # may exceed 1 by rounding
        level=float((cosine > np.cos(np.radians(_LEVEL))).mean()),
        walls=float((cosine < np.sin(np.radians(_LEVEL))).mean()),
        deviation=float(np.degrees(np.sqrt((scatter**2).mean() / len(means)))),
    )
    return up if up.tilt > max(_TILTED, _CERTAIN * up.deviation) else None


def world_normals(views: Views, assumed: Assumption) -> list[tuple[Floats, NDArray[np.bool_]]]:
    """Return for each frame the normals of its points in the world, float64 [N, 3], and which are known, bool [N]."""
    lens, poses = lens_under(views.lens, assumed), views.poses_of(assumed)
    world, known = views.world_points(assumed, lens, poses)
    found = []
    for row in range(len(views.looks)):
        local = (world[row][known[row]] - poses[row, :3, 3]) @ poses[row, :3, :3]
        surface = views.surface_at(row, local, assumed, lens[row])
        found.append((surface.normal @ poses[row, :3, :3].T, np.isfinite(surface.distance)))
    return found


def tilt_finding(examined: Examined, up: UpAxis, assumed: Assumption) -> Finding:
    """Return the finding that the world is tilted, with the option that corrects it."""
    turn = np.eye(3) if examined.scene.turn is None else examined.scene.turn
    written = turn.T @ up.axis  # in the poses' own world, as --up takes it
    axis = max(_AXES, key=lambda name: abs(float(written @ _AXES[name])))
    cosine = float(written @ _AXES[axis])
    way = axis if cosine > 0.0 else f"-{axis}"
    is_named = np.degrees(np.arccos(min(abs(cosine), 1.0))) < _NAMED_WITHIN
    option = f"read it with --up {way}, or " if is_named and way in ("z", "y", "-y") else ""
    best = max(range(len(examined.looks)), key=lambda row: len(examined.looks[row].points))
    normals, known = world_normals(examined.views, assumed)[best]
    shown = np.where(known[:, None], normals, 0.5)
    return Finding(
        cause="up direction",
        text=f"up is {up.tilt:.0f} degrees from z: {up.level:.0%} of the surfaces are level about the axis "
        f"{up.axis[0]:.2f}, {up.axis[1]:.2f}, {up.axis[2]:.2f} and {up.walls:.0%} upright"
        + (f"; that is the poses' axis {way}" if is_named else ""),
        option=f"{option}{MEND} writes a scene that is turned upright",
        figures={"degrees": up.tilt, "level": up.level, "walls": up.walls, "within_degrees": up.deviation, "axis": way},
        is_mended=True,
        picture=level_surfaces(examined.looks[best], shown @ up.axis, "green: level, blue: upright"),
    )
