"""The names that a 3D view shows, and what a legend beside them says: read while drawing, and for a click."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from .highlight import outline_in_space
from .lookup import boxes_of, instance_of, objects_by_key
from .selection import selected_instance
from .text_boxes import Rectangle, TextBox, ViewRegion, label_text_boxes
from .visibility import left_out

hovered: list[int] = []
"""The instance that the mouse is over, for its name; at most one. One Blender has one mouse."""


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


def shown_names(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    """The names at the boxes of a lift in the view of the context; none covers a mask that is outlined."""
    if not root.plgs.show_labels:
        return []
    boxes = {number: box for number, box in boxes_of(root).items() if _is_shown(context, root, box)}
    row, free = outlined(context, root), list[Rectangle]()
    for polygon in outline_of(context, row, region) if row is not None else ():
        across, up = zip(*polygon, strict=True)
        free.append((min(across), min(up), max(across), max(up)))
    active = selected_instance(root, context.view_layer.objects.active)
    return label_text_boxes(root.plgs.instances, boxes, active, region, hovered[0] if hovered else 0, free)


def _is_shown(context: bpy.types.Context, root: bpy.types.Collection, box: bpy.types.Object) -> bool:
    """Whether a box is in the view, or would be if boxes were on."""
    if root.plgs.show_boxes:
        return bool(box.visible_in_viewport_get(context.space_data))
    return not left_out(root.plgs, np.array([instance_of(box)]), np.array([int(box.get("class_id", 0))])).any()
