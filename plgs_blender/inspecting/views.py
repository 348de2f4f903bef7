"""Move the view: to a whole lift, to an instance, and to the camera of a frame that saw it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ...engine.errors import PlgsError
from ..boxes import INSTANCE
from ..owned import overview_of
from ..timeline import follow_camera, is_of_lift, places_of
from ..viewport import VIEW_SENSOR, areas_of, look_through, show_room
from .selection import box_of, objects_by_key, row_of, values_of

_ROOM_AROUND = 1.6  # radius of the sphere that fits in the view, in radii of the framed box


def frame_instance(root: bpy.types.Collection, instance: int, view: bpy.types.SpaceView3D, aspect: float = 1.0) -> None:
    """Move a 3D view, of width / height `aspect`, so that an instance's box (0: the active one) fills it. Raises
    PlgsError if there is no such instance or box."""
    box = box_of(root, instance)
    corners = np.array([box.matrix_world @ Vector(corner) for corner in box.bound_box])
    centre = corners.mean(axis=0)
    radius = float(np.linalg.norm(corners - centre, axis=1).max())
    region = view.region_3d
    if region.view_perspective == "CAMERA" and view.camera is not None:
        region.view_rotation = view.camera.matrix_world.to_quaternion()
        region.view_perspective = "PERSP"
    region.view_location = Vector(centre.tolist())
    # The longer side of the view has the lens's angle.
    half_angle = math.atan(VIEW_SENSOR / 2.0 / view.lens * min(aspect, 1.0 / aspect))
    region.view_distance = _ROOM_AROUND * radius / math.sin(half_angle)  # not tan: the view's cone touches a sphere


_before_alone: dict[int, tuple[Any, ...]] = {}
"""Perspective, rotation, location and distance of 3D views before an instance was isolated, by address."""


def show_alone(root: bpy.types.Collection, view: bpy.types.SpaceView3D, aspect: float) -> None:
    """Frame the isolated instance in a 3D view of width / height ``aspect``; restore the view if none is isolated."""
    region, key = view.region_3d, view.as_pointer()
    if not root.plgs.isolated:
        if key in _before_alone:
            region.view_perspective, region.view_rotation, region.view_location, region.view_distance = (
                _before_alone.pop(key)
            )
        return
    now = region.view_perspective, region.view_rotation.copy(), region.view_location.copy(), region.view_distance
    _before_alone.setdefault(key, now)  # not the view of an instance isolated before
    if f"{INSTANCE}{root.plgs.isolated}" in objects_by_key(root):
        frame_instance(root, root.plgs.isolated, view, aspect)


def best_frame(root: bpy.types.Collection, instance: int = 0) -> str:
    """The frame that shows most of an instance (0: the active one). Raises PlgsError if its masks are unknown."""
    row = row_of(root, instance)
    if not 0 <= row.best_mask < len(row.masks):
        fix = "Lift again: lifts of older versions did not record where the masks lie."
        raise PlgsError("no-best-frame", "has no masks that say where it is best seen", row.name, fix)
    row.mask_index = row.best_mask
    return str(row.masks[row.best_mask].frame)


def mask_frame(root: bpy.types.Collection, instance: int, frame: str, segment: int = 0) -> str:
    """Make one of the masks that were matched to an instance the active one in its list, and return the mask's frame.
    It is the mask of `frame` (with the id `segment`, unless 0), or the active mask if `frame` is "". Raises PlgsError
    if there is no such mask."""
    row = row_of(root, instance)
    chosen = [
        index
        for index, mask in enumerate(row.masks)
        if (mask.frame == frame and segment in (0, mask.segment)) or (not frame and index == row.mask_index)
    ]
    if not chosen:
        what = f"has no mask in frame {frame!r}" if frame else "has no mask chosen"
        raise PlgsError("no-such-mask", what, row.name, "Choose one of the masks that made it.")
    row.mask_index = chosen[0]
    return str(row.masks[chosen[0]].frame)


def look_from_frame(
    root: bpy.types.Collection, frame: str, scene: bpy.types.Scene, view: Any = None
) -> bpy.types.Object:
    """Let a 3D view (if any) look through a frame's camera, and return the camera. It becomes the scene's camera, at
    its timeline frame, unless the scene's camera is the user's. Raises PlgsError if the frame's camera was deleted."""
    camera = objects_by_key(root).get(f"frame:{frame}")
    if camera is None or camera.name not in scene.objects:
        what = f"has no camera of frame {frame} any more"
        raise PlgsError("camera-gone", what, root.name, "Show the lift's result again.")
    is_theirs = scene.camera is not None and not is_of_lift(scene.camera, scene)
    if not is_theirs:
        scene.camera = camera
        follow_camera(scene)
        frame_number = places_of(root, scene).get(camera)
        if frame_number is not None:
            scene.frame_set(frame_number)
            scene.camera = camera
    if view is not None:
        view.use_local_camera = is_theirs
        if is_theirs:
            view.camera = camera
        look_through(view, scene)
    return camera


def look_at_placed(root: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    """Point the 3D views that show the scene at its lift."""
    overview = overview_of(root)
    if overview is not None and len(root.plgs.classes):
        scene.view_layers[0].update()  # a new camera has no matrix_world before
        look_at_room(root, overview, areas_of(scene))


def look_at_room(root: bpy.types.Collection, overview: bpy.types.Object, areas: Iterable[bpy.types.Area]) -> None:
    """Point these 3D views at a lift's points, outliers excepted, with the rotation of its overview camera."""
    # Bounds come from the points themselves, because a hidden cloud has no bounding box.
    clouds = [ob for ob in root.all_objects if ob.type == "POINTCLOUD" and "class_id" in ob]
    low, high = np.percentile(np.concatenate([values_of(ob.data, "position") for ob in clouds]), (1.0, 99.0), axis=0)
    corners = np.array([*product(*np.stack([low, high], axis=1))])
    show_room(areas, overview.matrix_world.to_quaternion(), corners)
