"""Find what goes with removed objects: their own points and Gaussians, legs that masks missed, floating remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..corrections.fills import CELL, cell_keys, cells_of, with_neighbours
from ..lift.baking import OWNED
from .planes import ON_PLANE, Plane
from .views import GROWN, PlateView, grown

STRAY = 0.12
"""Metres from the objects' semantic points beyond which a mask has leaked."""
AROUND = 0.5
"""Metres around the objects in which planes are sought."""
OUTLINE = 20
"""Part of a photo's width within which a pixel is beside an outline."""
THINNED = 0.015
"""Metres between points of anything else."""
NEAR = 0.08
"""Metres around the objects' points within which a Gaussian needs a surface of something else to stay."""
ON_SURFACE = 0.025
"""Metres from a surface of something else within which a Gaussian belongs to it."""
MOST_POINTS = 40000
"""The most points of the objects that Gaussians are compared with."""
TOUCHED = 0.1
"""A Gaussian NEAR the objects leaves with more than this share of their labels; others need OWNED."""
LEGS, BESIDE_LEGS = 0.6, 0.12
"""Metres below an object and around its outline within which legs are sought."""
ABOVE_SUPPORT = 0.03
"""Metres above a support from which on a point belongs to what stands there."""


@dataclass(frozen=True, eq=False)
class Others:
    """The photos' points on anything that stays: ``xyz`` [N, 3] metres, ``label`` int32 [N], ``towards`` [N, 3], the
    direction to a camera that sees the point."""

    xyz: NDArray[np.float64]
    label: NDArray[np.int32]
    towards: NDArray[np.float64]

    def of(self, rows: NDArray[np.bool_]) -> Others:
        return Others(self.xyz[rows], self.label[rows], self.towards[rows])

    def are_far_from(self, xyz: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which of the positions ``xyz`` [M, 3] lie on no surface of these points, bool [M]."""
        on, _ = cKDTree(self.xyz).query(xyz, distance_upper_bound=ON_SURFACE, workers=-1)
        return np.isinf(on)


@dataclass(frozen=True, eq=False)
class Leaving:
    """The points of removed objects that photos saw: ``xyz`` [N, 3] metres; ``low``, ``high`` [3]: their box."""

    xyz: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, xyz: NDArray[np.float64]) -> Leaving:
        low, high = np.percentile(xyz, (1, 99), axis=0)
        return cls(xyz, low, high)


def leaving_points(views: Sequence[PlateView], points: NDArray[np.floating]) -> Leaving:
    """Return the points that the photos show on the objects with these semantic ``points`` [N, 3]."""
    inner = np.percentile(points, (2, 98), axis=0)
    points = points[((points >= inner[0] - 0.1) & (points <= inner[1] + 0.1)).all(axis=1)].astype(np.float64)
    parts = [points]
    for view in views:
        inside = ~grown(~view.leaves, 1) & (view.depth > 0)
        parts.append(view.camera.unproject(view.depth)[inside])
    found = np.concatenate(parts)
    return Leaving.of(found[np.isfinite(cKDTree(points).query(found, distance_upper_bound=STRAY, workers=-1)[0])])


def other_points(views: Sequence[PlateView], leaving: Leaving) -> Others:
    """Return what the photos show near the removed objects: points on anything else that are within AROUND of their box
    or beside their outlines, one in each cell of THINNED."""
    low, high, nowhere = leaving.low - AROUND, leaving.high + AROUND, np.zeros((0, 3))
    parts = [(nowhere, np.zeros(0, np.int32), nowhere)]  # if there is no view
    for view in views:
        world = view.camera.unproject(view.depth)
        near = ((world > low) & (world < high)).all(axis=-1) | grown(
            view.leaves, max(GROWN + 2, view.leaves.shape[1] // OUTLINE)
        )
        chosen = (view.depth > 0) & ~view.beside & near
        parts.append((world[chosen], view.label[chosen], view.camera.centre - world[chosen]))
    xyz, label, towards = (np.concatenate(each) for each in zip(*parts, strict=True))
    _, first = np.unique(cell_keys(np.floor(xyz / THINNED).astype(np.int64)), return_index=True)
    away = towards[first]
    return Others(xyz[first], label[first], away / np.linalg.norm(away, axis=1, keepdims=True))


def legs_of(leaving: Leaving, others: Others, planes: Sequence[Plane]) -> NDArray[np.bool_]:
    """Return which of the other points are parts of the objects that their masks missed, such as legs, bool [N]: points
    of stuff off every plane, between the objects' tops and what they stand on."""
    support = support_of(leaving, planes)
    if support is None:
        return np.zeros(len(others.xyz), np.bool_)
    height = others.xyz[:, 2]
    legs = (height > support + ABOVE_SUPPORT) & (height < leaving.high[2]) & (others.label <= 0)
    tree = cKDTree(leaving.xyz[:, :2])
    legs[legs] = np.isfinite(tree.query(others.xyz[legs][:, :2], distance_upper_bound=BESIDE_LEGS)[0])
    for plane in planes:
        on = np.abs(plane.local(others.xyz)[:, 2]) < 1.2 * ON_PLANE
        if legs[on].mean() < 0.5:  # else it is a side of the objects
            legs &= ~on
    return legs


def support_of(leaving: Leaving, planes: Sequence[Plane]) -> float | None:
    """Return the height in metres of the floor or table that the removed objects stand on; None if they hang."""
    floors = [plane.origin[2] for plane in planes if plane.is_floor and abs(plane.origin[2] - leaving.low[2]) < LEGS]
    below = [height for height in floors if height < leaving.low[2] + 0.1]
    return max(below) if below else None


def with_legs(
    views: Sequence[PlateView], leaving: Leaving, others: Others, planes: Sequence[Plane]
) -> tuple[list[PlateView], Leaving, Others]:
    """Count the legs that masks missed among the removed points. Returns the new views, removed points and others."""
    legs = legs_of(leaving, others, planes)
    if not legs.any():
        return list(views), leaving, others
    own = others.xyz[legs]
    cells = with_neighbours(cells_of(own))
    more = replace(leaving, xyz=np.concatenate([leaving.xyz, own]), low=np.minimum(leaving.low, own.min(axis=0)))
    cells = cells[cells[:, 2] * CELL > (support_of(leaving, planes) or 0.0) + ABOVE_SUPPORT - CELL]
    return [view.also_without(cells) for view in views], more, others.of(~legs)


def leaving_gaussians(
    centres: NDArray[np.floating], label: NDArray[np.int32], share: NDArray[np.floating], leaving: Leaving,
    others: Others,
) -> NDArray[np.bool_]:  # fmt: skip
    """Return which Gaussians, at ``centres`` [G, 3], go with the removed objects (``leaving``), bool [G]. These are
    Gaussians whose labels belong to the objects by a ``share`` [G] above OWNED, or above TOUCHED near the objects, and
    nearby Gaussians of stuff (by their likeliest ``label`` [G]) that lie on no surface of ``others``."""
    gone = share > OWNED
    low, high = leaving.low, leaving.high
    rows = np.flatnonzero(((centres > low - 0.15) & (centres < high + 0.15)).all(axis=1))
    some = centres[rows]
    own = cKDTree(leaving.xyz[:: max(1, len(leaving.xyz) // MOST_POINTS)])
    near, _ = own.query(some, distance_upper_bound=NEAR, workers=-1)
    is_near = np.isfinite(near) | ((some > low - ON_SURFACE) & (some < high + ON_SURFACE)).all(axis=1)
    gone[rows] |= is_near & ((others.are_far_from(some) & (label[rows] <= 0)) | (share[rows] > TOUCHED))
    return gone
