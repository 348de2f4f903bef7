"""What the mouse does in a 3D view that shows a lift: a click selects what is seen, and a name appears under it."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty

from ..plgs_blender.correction_tools import CUT
from ..plgs_blender.corrections import delete_around
from ..plgs_blender.errors import EXPECTED, one_line, plural, with_field_names
from ..plgs_blender.inspecting import picking, selection
from ..plgs_blender.inspecting.picking import hovered
from ..plgs_blender.inspecting.selection import objects_by_key
from ..plgs_blender.owned import KEY, LIFT, lifts_in, text_of
from .base import CANCELLED, FINISHED, PASSED_ON, reporting_events


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
        if _is_in_front(context, mouse, extend=self.extend):
            return FINISHED
        if picked.instance:
            selection.select_instance(picked.root, picked.instance, layer, extend=self.extend)
        else:
            selection.select_nothing(picked.root, picked.class_id, layer)
        context.area.tag_redraw()
        return FINISHED


def _is_in_front(context: bpy.types.Context, mouse: tuple[int, int], *, extend: bool) -> bool:
    """Let Blender select what it finds at a pixel, and tell whether that is no part of a lift's picture."""
    layer = context.view_layer
    before, active = [ob for ob in layer.objects if ob is not None and ob.select_get()], layer.objects.active
    if "FINISHED" not in bpy.ops.view3d.select(location=mouse, toggle=extend):
        return False
    found = layer.objects.active
    if found is not None and (extend or found.select_get()):
        if _lift_of(found, context.scene) is None or found.type == "CAMERA" or text_of(found, KEY) == CUT:
            return True
    if extend:
        selection.deselect_all(layer)
        for ob in before:
            ob.select_set(True)
        layer.objects.active = active
    return False


def _lift_of(ob: bpy.types.Object, scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The lift that an object is part of. None for the user's objects, and copies are the user's."""
    if not text_of(ob, LIFT):
        return None
    own = (root for root in lifts_in(scene) if root[LIFT] == ob[LIFT] and ob in objects_by_key(root).values())
    return next(own, None)


class PLGS_OT_point_at(InView, bpy.types.Operator):
    """Show the name of the object under the mouse"""

    bl_idname, bl_label, bl_options = "plgs.point_at", "Name What Is Seen", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        picked = picking.what_is_under(context, (event.mouse_region_x, event.mouse_region_y))
        now = [(picked.root.session_uid, picked.instance)] if picked is not None and picked.instance else []
        if now != hovered:
            hovered[:] = now
            context.area.tag_redraw()
        return PASSED_ON


class OnSelected(InView):
    """An operator of a key on the active object of a lift that is selected. On others the key is Blender's."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and cls.chosen(context) is not None

    @staticmethod
    def chosen(context: bpy.types.Context) -> tuple[bpy.types.Collection, int] | None:
        """The lift of the active object and its instance. A box that is switched off, which cannot be selected,
        counts while nothing is selected.
        """
        active = context.active_object
        root = None if active is None else _lift_of(active, context.scene)
        if root is None or not (active.select_get() or not context.selected_objects):
            return None
        number = selection.selected_instance(root, active)
        return (root, number) if number in {row.instance_id for row in root.plgs.instances} else None


class PLGS_OT_rename_selected(OnSelected, bpy.types.Operator):
    """Rename the active object of the lift"""

    bl_idname, bl_label, bl_options = "plgs.rename_selected", "Rename Object", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        chosen = self.chosen(context)
        if chosen is None:
            return PASSED_ON
        return set(bpy.ops.plgs.rename_instance("INVOKE_DEFAULT", lift=chosen[0].name, instance=chosen[1]))


class PLGS_OT_delete_selected(OnSelected, bpy.types.Operator):
    """Delete the selected objects of the lift, whose points become what is around them, and the user's selected ones"""

    bl_idname, bl_label, bl_options = "plgs.delete_selected", "Delete Objects", {"UNDO", "INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        chosen = self.chosen(context)
        if chosen is None:
            return CANCELLED
        root, active = chosen
        names = {row.instance_id: row.name for row in root.plgs.instances}
        numbers = selection.selected_instances(root, context.view_layer) or [active]
        numbers = [number for number in numbers if number in names]
        selected = {ob.session_uid: _lift_of(ob, context.scene) for ob in context.selected_objects}
        others = {uid for uid, lift in selected.items() if lift is None}
        try:
            delete_around(root, numbers)
        except EXPECTED as error:
            self.report({"ERROR"}, with_field_names(error))
            # What was deleted before the error is gone, and its undo step takes it back.
            return FINISHED if len(root.plgs.instances) < len(names) else CANCELLED
        # The lift's placement removes objects: what was found before it may be gone.
        found = [ob for ob in context.view_layer.objects if ob is not None and ob.session_uid in others]
        if found:
            with context.temp_override(selected_objects=found):
                bpy.ops.object.delete()
        kept = sum(ob.session_uid in selected for ob in context.view_layer.objects if ob is not None)
        stays = f". Not deleted: {plural(kept, 'other object')} of a lift" if kept else ""
        self.report({"INFO"}, one_line(f"Deleted: {', '.join(names[number] for number in numbers)}{stays}"))
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
