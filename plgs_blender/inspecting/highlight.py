"""What is highlighted in a 3D view: the selected instance's points and anchors, and the rectangle of a mask.

Read from Blender's data once a selection, and kept: a view is drawn many times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .lookup import clouds_of


@dataclass(frozen=True, eq=False)
class Highlight:
    """Points float32 [N, 3] in world metres; `shade` float32 [N] how light each is, so that shapes are seen; `radius`
    their mean in metres; what they belong to (`key`).
    """

    key: tuple[Any, ...]
    xyz: NDArray[np.float32]
    shade: NDArray[np.float32]
    radius: float


_Points = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""World positions [n, 3], shades [n] and radii [n]."""

_NOTHING: _Points = (np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32))
_LIGHT = np.array([0.35, -0.25, 0.9], np.float32)
_MIDDLE, _CONTRAST = 0.74, 0.3

_last: list[Highlight] = []


def highlight_of(root: bpy.types.Collection, instance: int, visible: Any) -> Highlight:
    """The points of an instance in the clouds that `visible(object)` says are seen."""
    clouds = [cloud for cloud in clouds_of(root) if visible(cloud)]
    key = (root.session_uid, instance, *map(_state_of, clouds))
    if not _last or _last[0].key != key:
        parts = [_points_of(cloud, instance) for cloud in clouds]
        xyz, shade, radius = (np.concatenate(each) for each in zip(_NOTHING, *parts, strict=True))
        _last[:] = [Highlight(key, xyz, shade, float(radius.mean()) if len(radius) else 0.0)]
    return _last[0]


def _state_of(cloud: bpy.types.Object) -> tuple[Any, ...]:
    """What tells that a cloud's points lie where they lay."""
    return cloud.data.session_uid, len(cloud.data.points), tuple(value for row in cloud.matrix_world for value in row)


def forget() -> None:
    """Let go of the kept points."""
    _last.clear()


def _points_of(cloud: bpy.types.Object, instance: int) -> _Points:
    """A cloud's points of an instance, lighter where they face up; anchors have no normals and are all light."""
    attributes, count = cloud.data.attributes, len(cloud.data.points)
    ids = np.zeros(count, np.int32)
    if "instance_id" in attributes:
        attributes["instance_id"].data.foreach_get("value", ids)
    mine = ids == instance
    if not mine.any():
        return _NOTHING
    xyz, radius = np.empty(3 * count, np.float32), np.empty(count, np.float32)
    attributes["position"].data.foreach_get("vector", xyz)
    attributes["radius"].data.foreach_get("value", radius)
    normal = np.zeros(3 * count, np.float32)
    if "normal" in attributes:
        attributes["normal"].data.foreach_get("vector", normal)
    world = np.array(cloud.matrix_world, np.float32)
    lit = normal.reshape(-1, 3)[mine] @ world[:3, :3].T @ _LIGHT
    shade = np.clip(_MIDDLE + _CONTRAST * lit, 0.0, 1.0) if "normal" in attributes else np.ones(len(lit), np.float32)
    return xyz.reshape(-1, 3)[mine] @ world[:3, :3].T + world[:3, 3], shade.astype(np.float32), radius[mine]


def rectangle_in_space(camera: bpy.types.Object, rectangle: tuple[float, float, float, float]) -> list[Vector]:
    """The corners of a rectangle (left, top, right, bottom, shares of the picture) of a frame's camera as world points
    one metre before it: where they are drawn, the mask lies on the photo. Empty when the user removed what the
    camera knows of its lens.
    """
    if any(name not in camera for name in ("width", "height", "fx", "fy", "cx", "cy")):
        return []
    left, top, right, bottom = rectangle
    corners = ((left, top), (right, top), (right, bottom), (left, bottom))
    # A Blender camera looks along -z with y up.
    local = [
        Vector((
            (u * camera["width"] - camera["cx"]) / camera["fx"],
            -(v * camera["height"] - camera["cy"]) / camera["fy"],
            -1.0,
        ))
        for u, v in corners
    ]
    return [camera.matrix_world @ corner for corner in local]
