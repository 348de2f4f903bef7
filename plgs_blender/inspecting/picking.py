"""The names that a 3D view shows, and what is under the mouse: a name's instance, or what the lift shows there.

Blender knows a lift's points as one object a class, its splats as one object, and boxes by their lines. The semantic
points lie on what is seen, however the lift is shown, and corrections change them at once. So they decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..owned import lifts_in
from .drawing import Rectangle, TextBox, ViewRegion, label_text_boxes
from .highlight import outline_in_space, state_of
from .looks import instances_left_out, leaving_out
from .selection import boxes_of, clouds_of, ids_of, objects_by_key, selected_instance

hovered: list[tuple[int, int]] = []
"""The instance that the mouse is over, for its name, after the session uid of its lift's collection; at most one. One
Blender has one mouse."""


@dataclass(frozen=True)
class DrawnNames:
    """The names of a lift that a 3D view showed when it was drawn last."""

    region: ViewRegion
    names: list[TextBox]


_drawn: dict[tuple[int, int], DrawnNames] = {}
"""By the pointer of the view's region and the session uid of the lift's collection. Blender draws a view again when
what it shows changes. The mouse moves far more often, and its names come from here."""
_MOST_KEPT = 16


def camera_of(context: bpy.types.Context) -> bpy.types.Object | None:
    """The camera that a 3D view looks through; None when it looks through none."""
    view = context.space_data
    if view.region_3d.view_perspective != "CAMERA":
        return None
    return view.camera if view.use_local_camera else context.scene.camera


def outlined(context: bpy.types.Context, root: bpy.types.Collection) -> Any:
    """The chosen instance's row, if the view looks through the camera of its chosen mask's frame."""
    lists, camera = root.plgs, camera_of(context)
    if camera is None or not 0 <= lists.instance_index < len(lists.instances):
        return None
    row = lists.instances[lists.instance_index]
    if not 0 <= row.mask_index < len(row.masks):
        return None
    mask = row.masks[row.mask_index]
    is_here = objects_by_key(root).get(f"frame:{mask.frame}") == camera and mask.rectangle[2] > 0.0
    return row if is_here else None


def outline_of(context: bpy.types.Context, row: Any, region: ViewRegion) -> list[list[tuple[float, float]]]:
    """The polygons, in pixels, of the chosen mask of an `outlined` row."""
    mask, found = row.masks[row.mask_index], []
    for polygon in outline_in_space(camera_of(context), mask.outline, tuple(mask.rectangle)):
        corners = [at for at in map(region.pixel_of, polygon) if at is not None]
        if len(corners) == len(polygon):
            found.append(corners)
    return found


def names_to_draw(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    """The names at the boxes of a lift in the view of the context, which is being drawn. `shown_names` has them then.
    None covers a mask that is outlined.
    """
    key = context.region.as_pointer(), root.session_uid
    _drawn.pop(key, None)
    _drawn[key] = DrawnNames(region, _names(context, root, region) if root.plgs.show_labels else [])
    while len(_drawn) > _MOST_KEPT:
        del _drawn[next(iter(_drawn))]
    return _drawn[key].names


def shown_names(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    """The names of a lift that the view of the context shows: those that were drawn last."""
    if not context.space_data.overlay.show_overlays:
        return []
    drawn = _drawn.get((context.region.as_pointer(), root.session_uid))
    return drawn.names if drawn is not None and drawn.region == region else names_to_draw(context, root, region)


def _names(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    boxes = _shown_boxes(context, root)
    row, free = outlined(context, root), list[Rectangle]()
    for polygon in outline_of(context, row, region) if row is not None else ():
        across, up = zip(*polygon, strict=True)
        free.append((min(across), min(up), max(across), max(up)))
    active = selected_instance(root, context.view_layer.objects.active)
    under = next((instance for lift, instance in hovered if lift == root.session_uid), 0)
    return label_text_boxes(root.plgs.instances, boxes, active, region, under, free)


def _shown_boxes(context: bpy.types.Context, root: bpy.types.Collection) -> dict[int, bpy.types.Object]:
    """The boxes, by instance, that are in the view, or would be if boxes were on."""
    boxes = boxes_of(root)
    if root.plgs.show_boxes:
        return {number: box for number, box in boxes.items() if box.visible_in_viewport_get(context.space_data)}
    hidden = dict(zip(boxes, instances_left_out(root.plgs, boxes), strict=True))
    return {number: box for number, box in boxes.items() if not hidden[number]}


_GAP = 12.0
"""Pixels to the nearest point, where no point covers the mouse."""
_COVER = 1.5
"""Radii that a point covers: the points of a surface leave gaps otherwise."""
_STRAYS, _THICK = 2, 0.05
"""So many points at one depth are no layer, and are seen through; the metres from a layer's front to its back."""


@dataclass(frozen=True)
class Picked:
    """What is under the mouse: an instance (0: none) and its class, of a lift, and its distance in metres."""

    root: bpy.types.Collection
    instance: int
    class_id: int
    depth: float = 0.0


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """The points of a lift that a view shows and that face it: their `place` in pixels from the lower left, float32
    [N, 2], `depth` in metres and `reach`, the pixels that each covers, float32 [N], and their instances and classes,
    `ids` int32 [N, 2]. `key` says of which state of the lift and view.
    """

    key: tuple[Any, ...]
    place: NDArray[np.float32]
    depth: NDArray[np.float32]
    reach: NDArray[np.float32]
    ids: NDArray[np.int32]

    def under(self, mouse: tuple[float, float]) -> int | None:
        """The row of the point that is seen at a pixel, None where none is: one of the nearest layer that covers the
        pixel, or lies all around it. Where no layer does, it is the nearest point.
        """
        aside = self.place - np.array(mouse, np.float32)
        away = np.hypot(*aside.T)
        rows = np.flatnonzero(away <= np.maximum(2.0 * self.reach, _GAP))
        rows = rows[np.argsort(self.depth[rows], kind="stable")]
        depth, at = self.depth[rows], 0
        while at < len(rows):
            end = int(np.searchsorted(depth, depth[at] + _THICK + 0.04 * depth[at]))
            layer = rows[at:end]
            is_around = (aside[layer].min(axis=0) < 0.0).all() and (aside[layer].max(axis=0) > 0.0).all()
            if len(layer) > _STRAYS and (is_around or (away[layer] <= self.reach[layer]).any()):
                return int(layer[np.argmin(away[layer])])
            at += 1
        near = rows[away[rows] <= np.maximum(self.reach[rows], _GAP)]
        return int(near[np.argmin(away[near])]) if len(near) else None


_last: dict[int, SeenPoints] = {}
"""By the session uid of the lift's collection."""


def forget() -> None:
    """Free what is kept."""
    hovered.clear()
    _drawn.clear()
    _last.clear()


def what_is_under(context: bpy.types.Context, mouse: tuple[float, float]) -> Picked | None:
    """What a 3D view shows at a pixel, counted from the lower left: a name's instance, or the nearest point of a lift.
    None where there is neither.
    """
    region, roots = ViewRegion.of(context), lifts_in(context.scene)
    for root in roots:
        number = name_under(shown_names(context, root, region), mouse)
        if number:
            return Picked(root, number, 0)
    size = (region.width, region.height)
    for gone in _last.keys() - {root.session_uid for root in roots}:
        del _last[gone]
    found = [each for root in roots if (each := point_under(root, context.region_data, size, mouse)) is not None]
    return min(found, key=lambda each: each.depth, default=None)


def name_under(names: list[TextBox], mouse: tuple[float, float]) -> int:
    """The instance whose name is under the mouse, 0 when none is."""
    for box in names:
        if 0.0 <= mouse[0] - box.x < box.width and 0.0 <= mouse[1] - box.y < box.height:
            return box.instance
    return 0


def point_under(
    root: bpy.types.Collection, view: Any, size: tuple[int, int], mouse: tuple[float, float]
) -> Picked | None:
    """What a lift shows at a pixel of a RegionView3D of this size (width, height); None where nothing is."""
    clouds = [cloud for cloud in clouds_of(root) if "class_id" in cloud and len(cloud.data.points)]
    matrices = np.array(view.view_matrix, np.float32), np.array(view.window_matrix, np.float32)
    if not clouds:
        return None
    are_shown = [row.visible for row in (*root.plgs.instances, *root.plgs.classes)]
    key = (root.plgs.isolated, *are_shown, *map(state_of, clouds), size, *map(bytes, matrices))
    seen = _last.get(root.session_uid)
    if seen is None or seen.key != key:
        parts = [_seen(root, cloud, *matrices, view.is_perspective, size) for cloud in clouds]
        seen = SeenPoints(key, *(np.concatenate(each) for each in zip(*parts, strict=True)))
        _last[root.session_uid] = seen
    row = seen.under(mouse)
    if row is None:
        return None
    instance, class_id = seen.ids[row].tolist()
    return Picked(root, instance, class_id, float(seen.depth[row]))


def _seen(
    root: bpy.types.Collection,
    cloud: bpy.types.Object,
    looks: NDArray[np.float32],
    lens: NDArray[np.float32],
    is_perspective: bool,
    size: tuple[int, int],
) -> tuple[NDArray[Any], ...]:
    """Place, depth, reach and ids of a cloud's points as `SeenPoints` has them. Those that face away are left out."""
    data, world = cloud.data, looks @ np.array(cloud.matrix_world, np.float32)
    xyz = _column(data, "position", "vector", 3) @ world[:3, :3].T + world[:3, 3]
    clip = np.c_[xyz, np.ones(len(xyz), np.float32)] @ lens.T
    w = np.maximum(clip[:, 3:], 1e-6)
    ids = np.stack([ids_of(data, "instance_id"), ids_of(data, "class_id")], axis=1)
    shown = (clip[:, 3] > 0.0) & (np.abs(clip[:, :2]) < w).all(axis=1) & ~leaving_out(root.plgs)(*ids.T)
    if "normal" in data.attributes:
        normal = _column(data, "normal", "vector", 3) @ world[:3, :3].T
        shown &= (normal * (xyz if is_perspective else np.array([0.0, 0.0, -1.0]))).sum(axis=1) <= 0.0
    place = (clip[:, :2] / w + 1.0) * np.array(size, np.float32) / 2.0
    reach = _COVER * _column(data, "radius", "value", 1)[:, 0] * lens[0, 0] * size[0] / 2.0 / w[:, 0]
    return tuple(each[shown].astype(np.float32) for each in (place, -xyz[:, 2], reach)) + (ids[shown],)


def _column(data: bpy.types.PointCloud, name: str, field: str, width: int) -> NDArray[np.float32]:
    values = np.empty(width * len(data.points), np.float32)
    data.attributes[name].data.foreach_get(field, values)
    return values.reshape(-1, width)
