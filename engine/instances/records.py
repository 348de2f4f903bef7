"""Records of masks and objects, which the stages of a lift fill in, and boxes oriented about the up axis. The paper's
boxes are "oriented around z-axis for simplification" (section "Consistent Instance Mask Generation"): the smallest
rectangle around the points as seen from above, extended over their range of z."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene import Segment


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box turned about z. ``centre``, ``size``: float64 [3], metres, with size[0] >= size[1]; ``yaw``: the angle from
    +x to the first axis, radians, in [-pi/2, pi/2)."""

    centre: NDArray[np.float64]
    size: NDArray[np.float64]
    yaw: float

    @property
    def volume(self) -> float:
        """The volume in cubic metres."""
        return float(np.prod(self.size))

    @property
    def rotation(self) -> tuple[float, float, float, float]:
        """The turn by ``yaw`` as a unit quaternion (w, x, y, z)."""
        return math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2)

    @property
    def footprint(self) -> NDArray[np.float64]:
        """The corners as seen from above, counter-clockwise, float64 [4, 2], metres."""
        x, y = self.size[:2] / 2
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        local = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
        return local @ np.array([[cos, sin], [-sin, cos]]) + self.centre[:2]

    @property
    def corners(self) -> NDArray[np.float64]:
        """The eight corners, float64 [8, 3], metres: the footprint at the bottom, then at the top."""
        low, high = self.centre[2] - self.size[2] / 2, self.centre[2] + self.size[2] / 2
        foot = self.footprint
        return np.concatenate([np.column_stack([foot, np.full(4, z)]) for z in (low, high)])


def fit_box(points: NDArray[np.floating], min_thickness: float) -> OrientedBox:
    """Return the box of the smallest footprint around points [N, 3], metres; no side is shorter than ``min_thickness``,
    metres. Raises ValueError if there are no points."""
    if not len(points):
        raise ValueError("a box needs at least one point")
    xyz = np.asarray(points, np.float64)
    # OpenCV uses single precision. Coordinates relative to the middle of the points keep millimetres anywhere.
    origin = (xyz.min(0) + xyz.max(0)) / 2
    (x, y), (width, depth), degrees = cv2.minAreaRect((xyz[:, :2] - origin[:2]).astype(np.float32))
    yaw = math.radians(degrees)
    if depth > width:
        width, depth, yaw = depth, width, yaw + math.pi / 2
    yaw = (yaw + math.pi / 2) % math.pi - math.pi / 2
    low, high = xyz[:, 2].min(), xyz[:, 2].max()
    centre = np.array([x + origin[0], y + origin[1], (low + high) / 2])
    return OrientedBox(centre, np.maximum([width, depth, high - low], min_thickness), yaw)


def intersection_volume(first: OrientedBox, second: OrientedBox) -> float:
    """Return ||inter(B1, B2)|| of the paper, cubic metres: the common area of the footprints times the overlap in z."""
    top = min(float(box.centre[2] + box.size[2] / 2) for box in (first, second))
    overlap = top - max(float(box.centre[2] - box.size[2] / 2) for box in (first, second))
    reach = (math.hypot(*first.size[:2]) + math.hypot(*second.size[:2])) / 2  # circles around both: most are far apart
    if overlap <= 0 or math.dist(first.centre[:2], second.centre[:2]) >= reach:
        return 0.0
    common = _clip(first.footprint.tolist(), second.footprint.tolist())
    if len(common) < 3:
        return 0.0
    x, y = np.array(common).T
    return overlap * (abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2)  # the shoelace formula


def _clip(polygon: list[list[float]], window: list[list[float]]) -> list[list[float]]:
    """Return the part of a convex polygon inside a convex, counter-clockwise window, by Sutherland and Hodgman."""
    for (ax, ay), (bx, by) in zip(window, window[1:] + window[:1], strict=True):
        side = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in polygon]
        kept: list[list[float]] = []
        for i, (here, point) in enumerate(zip(side, polygon, strict=True)):
            before, previous = side[i - 1], polygon[i - 1]
            if (here >= 0) != (before >= 0):
                t = before / (before - here)
                kept.append([p + t * (q - p) for p, q in zip(previous, point, strict=True)])
            if here >= 0:
                kept.append(point)
        polygon = kept
    return polygon


@dataclass(frozen=True)
class ObjectMask:
    """A mask of an object: the ``segment`` of a ``frame``. ``pixels``: how many have depth, 0 until counted. ``cost``:
    O of the match by boxes, None for the object's first mask. ``agreement``: views judge for each other mask of the
    object whether both masks are inside one; this is the share of judgements that say so, None if there are none."""

    frame: str
    segment: Segment
    pixels: int = 0
    cost: float | None = None
    agreement: float | None = None

    @property
    def key(self) -> tuple[str, int]:
        """What identifies the mask: its frame's name and its segment's id."""
        return self.frame, self.segment.id


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object: ``id``, from 1; ``masks``; class (0 until known); ``points`` float64 [n, 3], metres; and the ``box``
    around them (of size zero without points)."""

    id: int
    masks: tuple[ObjectMask, ...]
    class_id: int = 0
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    box: OrientedBox = field(default_factory=lambda: OrientedBox(np.zeros(3), np.zeros(3), 0.0))

    @property
    def views(self) -> int:
        return len({mask.frame for mask in self.masks})

    @property
    def score(self) -> float:
        """The mean of the masks' scores."""
        return sum(mask.segment.score for mask in self.masks) / len(self.masks)

    @property
    def pixels(self) -> int:
        return sum(mask.pixels for mask in self.masks)


def object_of_mask(objects: Sequence[SceneObject]) -> dict[tuple[str, int], int]:
    """Return the id of each mask's object, by frame name and segment id."""
    return {mask.key: one.id for one in objects for mask in one.masks}
