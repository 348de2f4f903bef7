"""Find the names shown in a 3D view, and what is under the mouse: a name's instance, or what the lift draws there. To
Blender, a lift's points are one object per class and its splats are one object, so `rays` finds the instance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import bpy

from . import rays
from .drawing import Rectangle, TextBox, ViewRegion, label_text_boxes
from .highlight import outline_in_space
from .looks import instances_left_out, lifts_shown
from .selection import boxes_of, instance_of, objects_by_key, selected_instance

hovered: list[tuple[int, int]] = []
"""The session uid of a lift's collection and its instance under the mouse; at most one."""


_drawn: dict[tuple[int, int], tuple[ViewRegion, list[TextBox]]] = {}
"""The names last drawn in a view, by its region's pointer and the session uid of the lift's collection."""
_MOST_KEPT = 16


def camera_of(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the camera that a 3D view looks through, None if it looks through none."""
    view = context.space_data
    if view.region_3d.view_perspective != "CAMERA":
        return None
    return view.camera if view.use_local_camera else context.scene.camera


def outlined(context: bpy.types.Context, root: bpy.types.Collection) -> Any:
    """The row of the list's active instance, if the view looks through the camera of the frame of the row's chosen
    mask, so that the mask is outlined; else None."""
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
    """Return the polygons, in pixels, of the chosen mask in a row from `outlined`."""
    mask, found = row.masks[row.mask_index], []
    for polygon in outline_in_space(camera_of(context), mask.outline, tuple(mask.rectangle)):
        corners = [at for at in map(region.pixel_of, polygon) if at is not None]
        if len(corners) == len(polygon):
            found.append(corners)
    return found


def names_to_draw(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    """Return the names at a lift's boxes in the view that is being drawn, and store them for `shown_names`."""
    key = context.region.as_pointer(), root.session_uid
    _drawn.pop(key, None)  # so that it becomes the newest
    _drawn[key] = region, _names(context, root, region) if root.plgs.show_labels else []
    while len(_drawn) > _MOST_KEPT:
        del _drawn[next(iter(_drawn))]  # the oldest, as dicts keep their order
    return _drawn[key][1]


def shown_names(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    """Return the names that were last drawn for a lift in the context's view."""
    if not context.space_data.overlay.show_overlays:
        return []
    drawn = _drawn.get((context.region.as_pointer(), root.session_uid))
    return drawn[1] if drawn is not None and drawn[0] == region else names_to_draw(context, root, region)


def _names(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> list[TextBox]:
    """Return names at the visible boxes; none covers an outlined mask."""
    boxes = _shown_boxes(context, root)
    row, free = outlined(context, root), list[Rectangle]()
    for polygon in outline_of(context, row, region) if row is not None else ():
        across, up = zip(*polygon, strict=True)
        free.append((min(across), min(up), max(across), max(up)))
    active = selected_instance(root, context.view_layer.objects.active)
    under = next((instance for lift, instance in hovered if lift == root.session_uid), 0)
    return label_text_boxes(root.plgs.instances, boxes, active=active, region=region, hovered=under, keep_free=free)


def _shown_boxes(context: bpy.types.Context, root: bpy.types.Collection) -> dict[int, bpy.types.Object]:
    """Return the boxes, by instance, that are visible in the view, or would be if boxes were on."""
    boxes, space = boxes_of(root), context.space_data
    if space.local_view is not None:  # it contains only objects that the user has chosen
        own = {instance_of(ob) for ob in objects_by_key(root).values() if instance_of(ob) and ob.local_view_get(space)}
        boxes = {number: box for number, box in boxes.items() if number in own}
    if root.plgs.show_boxes:
        return {number: box for number, box in boxes.items() if box.visible_get(viewport=space)}
    hidden = dict(zip(boxes, instances_left_out(root.plgs, boxes), strict=True))
    return {number: box for number, box in boxes.items() if not hidden[number]}


@dataclass(frozen=True)
class Picked:
    """What is under the mouse: an instance (0: none) of a lift, and its class."""

    root: bpy.types.Collection
    instance: int
    class_id: int


def forget() -> None:
    """Clear the cache of names."""
    hovered.clear()
    _drawn.clear()
    rays.cached.clear()


def what_is_under(context: bpy.types.Context, mouse: tuple[float, float]) -> Picked | None:
    """Return what a 3D view shows at a pixel (from the lower left): a name's instance, a lift's drawing, or None."""
    roots, space = lifts_shown(context.scene, context.view_layer), context.space_data
    region = ViewRegion.of(context)
    for root in roots:
        number = name_under(shown_names(context, root, region), mouse)
        if number:
            return Picked(root, number, 0)
    view = rays.View.of(context.region_data, (region.width, region.height), context.scene, space)
    return drawn_under(roots, view, mouse, space)


def name_under(names: list[TextBox], mouse: tuple[float, float]) -> int:
    """Return the instance whose name is under the mouse, or 0."""
    for box in names:
        if 0.0 <= mouse[0] - box.x < box.width and 0.0 <= mouse[1] - box.y < box.height:
            return box.instance
    return 0


def drawn_under(
    roots: Iterable[bpy.types.Collection],
    view: rays.View,
    mouse: tuple[float, float],
    space: bpy.types.SpaceView3D | None = None,
) -> Picked | None:
    """Return what lifts draw at a pixel of a view, or None. What the `space` (None: the window) hides is left out."""
    parts = [(root, part) for root in roots for part in rays.parts_near(root, view, mouse, space)]
    first = rays.first_drawn([part for _, part in parts], mouse)
    return None if first is None else Picked(parts[first[0]][0], *first[1:])
