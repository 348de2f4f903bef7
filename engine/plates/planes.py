"""Find the planes around removed objects: floors, walls, table tops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

ON_PLANE = 0.02
"""Metres from a plane within which a point is on it."""
MOST, TRIES, SAMPLE = 6, 150, 4000
"""The most planes that are sought, the tries for each, and the points that judge a try."""
LEAST_SHARE, LEAST_POINTS = 0.04, 60
"""A plane has at least this share of the points, and this many."""
_SEED_REACH = 0.25
"""Metres within which the three points of a try lie."""
PARALLEL, NEAR, SLOPE = 0.99, 4 * ON_PLANE, 0.7
"""A plane is the noise of a larger one if it is this parallel (cosine), within these metres of it, and at least this
share of the points around it lies on the larger one's side."""
UPRIGHT = 0.95
"""Least upward part of the normal of a floor or a table's top, and of a direction in a wall."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane: ``origin`` [3] m; ``axes`` [3, 3]: two directions in it, and its normal, which faces the cameras."""

    origin: NDArray[np.float64]
    axes: NDArray[np.float64]

    def local(self, xyz: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return positions [N, 3] in the plane's axes; the third coordinate is the height above the plane."""
        return (xyz - self.origin) @ self.axes.T

    def world(self, uv: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the world positions [..., 3] of positions [..., 2] within the plane."""
        return uv @ self.axes[:2] + self.origin

    @property
    def is_floor(self) -> bool:
        return bool(self.axes[2, 2] > UPRIGHT)

    @property
    def is_wall(self) -> bool:
        return bool(self.axes[1, 2] > UPRIGHT)


def find_planes(xyz: NDArray[np.floating], towards: NDArray[np.floating]) -> list[Plane]:
    """Find the planes of points [N, 3], largest first, by RANSAC. ``towards`` [N, 3] points to their cameras."""
    random = np.random.default_rng(0)
    left, least = np.arange(len(xyz)), max(LEAST_POINTS, int(LEAST_SHARE * len(xyz)))
    planes: list[Plane] = []
    while len(planes) < MOST and len(left) >= least:
        found = _largest(xyz[left], random)
        if found is None or (on := np.abs(xyz[left] @ found[0] - found[1]) < ON_PLANE).sum() < least:
            break
        normal, offset = found
        if np.median(towards[left[on]] @ normal) < 0:
            normal, offset = -normal, -offset
        plane = Plane(xyz[left[on]].mean(axis=0).astype(np.float64), _axes(normal))
        if not any(_is_noise_of(one, plane, xyz) for one in planes):
            planes.append(plane)
        left = left[np.abs(xyz[left] @ normal - offset) > 1.5 * ON_PLANE]
    return planes


def _is_noise_of(larger: Plane, plane: Plane, xyz: NDArray[np.floating]) -> bool:
    """Whether a plane is but noise of a larger one beside it: most of the points [N, 3] around it are on that side."""
    away = float(larger.local(plane.origin[None])[0, 2])
    if plane.axes[2] @ larger.axes[2] < PARALLEL or abs(away) > NEAR:
        return False
    height = plane.local(xyz)[:, 2] * np.sign(away)
    on = np.abs(height) < ON_PLANE
    return bool((height[on] < 0).mean() > SLOPE)


def _largest(xyz: NDArray[np.floating], random: np.random.Generator) -> tuple[NDArray[np.float64], float] | None:
    """Return normal and offset of the plane with most of the points [N, 3]; None if they span no plane."""
    sample = xyz[random.permutation(len(xyz))[:SAMPLE]].astype(np.float64)
    near = cKDTree(sample).query_ball_point(sample[random.integers(len(sample), size=TRIES)], _SEED_REACH)
    corners = np.array([random.choice(ball, 3) for ball in near])
    a, b, c = sample[corners.T]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    if not (proper := lengths > 1e-6).any():
        return None
    normals, a = normals[proper] / lengths[proper, None], a[proper]
    counts = (np.abs(sample @ normals.T - (a * normals).sum(axis=1)) < ON_PLANE).sum(axis=0)
    normal = normals[best := int(counts.argmax())]
    offset = float(a[best] @ normal)
    for _ in range(3):
        on = xyz[np.abs(xyz @ normal - offset) < ON_PLANE].astype(np.float64)
        centre = on.mean(axis=0)
        normal = np.linalg.svd(on[:: max(1, len(on) // 5000)] - centre, full_matrices=False)[2][2]
        offset = float(centre @ normal)
    return normal, offset


def _axes(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return axes [3, 3] of a plane with this normal, the first of them level."""
    across = np.cross([0.0, 0.0, 1.0], normal)
    if np.linalg.norm(across) < 0.3:
        across = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(normal, across), normal])
