"""What is highlighted in a 3D view: the selected instance's points and anchors, and the outline of a mask.

A view is drawn many times, so points are read from Blender's data once for each selection, and kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..materials import LIGHT, SHADE, SHADE_CONTRAST
from .lookup import clouds_of, ids_of


@dataclass(frozen=True, eq=False)
class Highlight:
    """Points `xyz` float32 [N, 3] in world metres, their lightness `shade` float32 [N], which makes shapes visible, and
    their mean `radius` in metres. `key` says which instance and clouds they were read from.
    """

    key: tuple[Any, ...]
    xyz: NDArray[np.float32]
    shade: NDArray[np.float32]
    radius: float


_Points = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""World positions [n, 3], shades [n] and radii [n]."""

_NOTHING: _Points = (np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32))
NOTHING = Highlight((), *_NOTHING[:2], 0.0)
"""No points."""
_last: list[Highlight] = []


def highlight_of(root: bpy.types.Collection, instance: int, visible: Any) -> Highlight:
    """The points of an instance in the clouds that are seen, as `visible(object)` says."""
    clouds = [cloud for cloud in clouds_of(root) if visible(cloud)]
    key = (root.session_uid, instance, *map(_state_of, clouds))
    if not _last or _last[0].key != key:
        parts = [_points_of(cloud, instance) for cloud in clouds]
        xyz, shade, radius = (np.concatenate(each) for each in zip(_NOTHING, *parts, strict=True))
        _last[:] = [Highlight(key, xyz, shade, float(radius.mean()) if len(radius) else 0.0)]
    return _last[0]


def _state_of(cloud: bpy.types.Object) -> tuple[Any, ...]:
    """What changes when a cloud's points move or are replaced."""
    return cloud.data.session_uid, len(cloud.data.points), tuple(value for row in cloud.matrix_world for value in row)


def forget() -> None:
    """Free the kept points."""
    _last.clear()


def _points_of(cloud: bpy.types.Object, instance: int) -> _Points:
    """A cloud's points of an instance, lighter where they face up. Anchors have no normals and are all light."""
    attributes, count = cloud.data.attributes, len(cloud.data.points)
    mine = ids_of(cloud.data, "instance_id") == instance
    if not mine.any():
        return _NOTHING
    xyz, radius = np.empty(3 * count, np.float32), np.empty(count, np.float32)
    attributes["position"].data.foreach_get("vector", xyz)
    attributes["radius"].data.foreach_get("value", radius)
    normal = np.zeros(3 * count, np.float32)
    if "normal" in attributes:
        attributes["normal"].data.foreach_get("vector", normal)
    world = np.array(cloud.matrix_world, np.float32)
    lit = normal.reshape(-1, 3)[mine] @ world[:3, :3].T @ np.array(LIGHT, np.float32)
    shade = np.clip(SHADE + SHADE_CONTRAST * lit, 0.0, 1.0) if "normal" in attributes else np.ones(len(lit), np.float32)
    return xyz.reshape(-1, 3)[mine] @ world[:3, :3].T + world[:3, 3], shade.astype(np.float32), radius[mine]


def outline_in_space(
    camera: bpy.types.Object, outline: str, rectangle: tuple[float, float, float, float]
) -> list[list[Vector]]:
    """The polygons of a mask's outline in the picture of a frame's camera, as world points one metre in front of the
    camera; the rectangle around the mask where a lift has no outlines. Both are as `MatchedSegment` has them. Empty
    when the user removed the lens properties from the camera.
    """
    if any(name not in camera for name in ("width", "height", "fx", "fy", "cx", "cy")):
        return []

    def in_space(u: float, v: float) -> Vector:
        x = (u * camera["width"] - camera["cx"]) / camera["fx"]
        y = (v * camera["height"] - camera["cy"]) / camera["fy"]
        return camera.matrix_world @ Vector((x, -y, -1.0))  # a Blender camera looks along -z with y up

    left, top, right, bottom = rectangle
    polygons = [[corner.split(",") for corner in polygon.split()] for polygon in outline.split(";") if polygon]
    found = [[(float(u), float(v)) for u, v in polygon] for polygon in polygons]
    found = found or [[(left, top), (right, top), (right, bottom), (left, bottom)]]
    return [[in_space(u, v) for u, v in polygon] for polygon in found]
