"""What the mouse does in a 3D view that shows a lift: a click selects what is seen, and a name appears under it."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty

from ..plgs_blender.corrections import CUT, delete
from ..plgs_blender.errors import one_line
from ..plgs_blender.inspecting import picking, selection
from ..plgs_blender.inspecting.lookup import find_lift, instance_of, row_of
from ..plgs_blender.inspecting.names import hovered
from ..plgs_blender.lift_collection import lifts_in
from ..plgs_blender.owned import KEY, LIFT, text_of
from .base import FINISHED, PASSED_ON, reporting, reporting_events


class InView:
    """An operator of the mouse in a 3D view that shows a lift, in Object Mode. It has no button."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        in_view = context.area is not None and context.area.type == "VIEW_3D" and context.mode == "OBJECT"
        return in_view and any(len(root.plgs.classes) for root in lifts_in(context.scene))


class PLGS_OT_pick(InView, bpy.types.Operator):
    """Select what is seen under the mouse: a name's object, or that of the points, splats or surface there"""

    bl_idname, bl_label, bl_options = "plgs.pick", "Select What Is Seen", {"UNDO", "INTERNAL"}

    extend: BoolProperty(name="Extend", options={"SKIP_SAVE"}, description="Keep what is selected, or deselect it")  # type: ignore[valid-type]

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        keys = context.window_manager.keyconfigs.active.preferences
        if event.type != f"{getattr(keys, 'select_mouse', 'LEFT')}MOUSE":
            return PASSED_ON
        mouse, layer = (event.mouse_region_x, event.mouse_region_y), context.view_layer
        picked = picking.what_is_under(context, mouse)
        if picked is None or (self.extend and not picked.instance):
            return PASSED_ON
        if not self.extend and _is_in_front(layer, mouse):
            return FINISHED
        if picked.instance:
            selection.select_instance(picked.root, picked.instance, layer, extend=self.extend)
        else:
            selection.select_nothing(picked.root, picked.class_id, layer)
        context.area.tag_redraw()
        return FINISHED


def _is_in_front(layer: bpy.types.ViewLayer, mouse: tuple[int, int]) -> bool:
    """Let Blender select what it finds at a pixel. Whether that is no part of a lift's picture: an object of the
    user's, a camera, or the cutting plane.
    """
    if "FINISHED" not in bpy.ops.view3d.select(location=mouse):
        return False
    found = layer.objects.active
    if found is None or not found.select_get() or instance_of(found):
        return False
    return not text_of(found, LIFT) or found.type == "CAMERA" or text_of(found, KEY) == CUT


class PLGS_OT_point_at(InView, bpy.types.Operator):
    """Show the name of the object under the mouse"""

    bl_idname, bl_label, bl_options = "plgs.point_at", "Name What Is Seen", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        picked = picking.what_is_under(context, (event.mouse_region_x, event.mouse_region_y))
        now = [picked.instance] if picked is not None and picked.instance else []
        if now != hovered:
            hovered[:] = now
            context.area.tag_redraw()
        return PASSED_ON


class OnSelected(InView):
    """An operator of a key on the active object of a lift. On other objects the key is Blender's."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and bool(instance_of(context.active_object))


class PLGS_OT_rename_selected(OnSelected, bpy.types.Operator):
    """Rename the active object of the lift"""

    bl_idname, bl_label, bl_options = "plgs.rename_selected", "Rename Object", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        number = instance_of(context.active_object)
        return set(bpy.ops.plgs.rename_instance("INVOKE_DEFAULT", instance=number))


class PLGS_OT_delete_selected(OnSelected, bpy.types.Operator):
    """Delete the selected objects of the lift, whose points become what is around them, and all other selected ones"""

    bl_idname, bl_label, bl_options = "plgs.delete_selected", "Delete Objects", {"UNDO", "INTERNAL"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root, layer = find_lift(context.scene, active=context.active_object), context.view_layer
        numbers = selection.selected_instances(root, layer) or [row_of(root, 0).instance_id]
        others = [ob for ob in context.selected_objects if not instance_of(ob)]
        names = [row_of(root, number).name for number in numbers]
        for number in numbers:
            delete(root, number, around=True)
        if others:
            with context.temp_override(selected_objects=others):
                bpy.ops.object.delete()
        self.report({"INFO"}, one_line(f"Deleted: {', '.join(names)}"))
        return FINISHED


CLASSES = (PLGS_OT_pick, PLGS_OT_point_at, PLGS_OT_rename_selected, PLGS_OT_delete_selected)

_KEYS: tuple[tuple[str, str, str, dict[str, Any], dict[str, Any]], ...] = (
    ("plgs.point_at", "MOUSEMOVE", "ANY", {}, {}),
    ("plgs.pick", "LEFTMOUSE", "CLICK", {}, {}),
    ("plgs.pick", "LEFTMOUSE", "CLICK", {"shift": True}, {"extend": True}),
    ("plgs.pick", "RIGHTMOUSE", "PRESS", {}, {}),
    ("plgs.pick", "RIGHTMOUSE", "PRESS", {"shift": True}, {"extend": True}),
    ("plgs.rename_selected", "F2", "PRESS", {}, {}),
    ("plgs.delete_selected", "X", "PRESS", {}, {}),
    ("plgs.delete_selected", "DEL", "PRESS", {}, {}),
)
"""Operator, key, event, modifiers, and the operator's properties, in Object Mode of the 3D view."""
_added: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


def register() -> None:
    """Add the keys where the preferences show them, and users change them. Blender without a window has none."""
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is None:
        return
    keymap = keys.keymaps.new("Object Mode", space_type="EMPTY")
    for operator, key, event, modifiers, given in _KEYS:
        item = keymap.keymap_items.new(operator, key, event, **modifiers)
        for name, value in given.items():
            setattr(item.properties, name, value)
        _added.append((keymap, item))


def unregister() -> None:
    while _added:
        keymap, item = _added.pop()
        keymap.keymap_items.remove(item)
    picking.forget()
