"""What glows over the view: the points and anchors of the selected instance, and the rectangle of a mask.

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
class Glow:
    """Points float32 [N, 3] in world metres; `radius` their mean in metres; what they belong to (`key`)."""

    key: tuple[Any, ...]
    xyz: NDArray[np.float32]
    radius: float


_last: list[Glow] = []


def glow_of(root: bpy.types.Collection, instance: int, visible: Any) -> Glow:
    """The points of an instance in the clouds that `visible(object)` says are seen."""
    clouds = [cloud for cloud in clouds_of(root) if visible(cloud)]
    key = (root.session_uid, instance, *((cloud.data.session_uid, len(cloud.data.points)) for cloud in clouds))
    if not _last or _last[0].key != key:
        parts = [_points_of(cloud, instance) for cloud in clouds]
        xyz = np.concatenate([part for part, _ in parts]) if parts else np.zeros((0, 3), np.float32)
        radii = np.concatenate([radius for _, radius in parts]) if parts else np.zeros(0, np.float32)
        _last[:] = [Glow(key, xyz, float(radii.mean()) if len(radii) else 0.0)]
    return _last[0]


def forget() -> None:
    """Let go of the kept points."""
    _last.clear()


def _points_of(cloud: bpy.types.Object, instance: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """World positions and radii of a cloud's points of an instance."""
    attributes, count = cloud.data.attributes, len(cloud.data.points)
    ids = np.zeros(count, np.int32)
    if "instance_id" in attributes:
        attributes["instance_id"].data.foreach_get("value", ids)
    mine = ids == instance
    if not mine.any():
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    xyz, radius = np.empty(3 * count, np.float32), np.empty(count, np.float32)
    attributes["position"].data.foreach_get("vector", xyz)
    attributes["radius"].data.foreach_get("value", radius)
    world = np.array(cloud.matrix_world, np.float32)
    return xyz.reshape(-1, 3)[mine] @ world[:3, :3].T + world[:3, 3], radius[mine]


def rectangle_in_space(camera: bpy.types.Object, rectangle: tuple[float, float, float, float]) -> list[Vector]:
    """The corners of a rectangle (left, top, right, bottom, shares of the picture) of a frame's camera as world points
    one metre before it: where they are drawn, the mask lies on the photo.
    """
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
