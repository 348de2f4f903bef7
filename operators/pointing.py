"""Use the mouse in a 3D view of a lift: a click selects what is under it, and hovering shows its name."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..plgs_blender.corrections import delete_around
from ..plgs_blender.errors import EXPECTED, one_line, plural, with_field_names
from ..plgs_blender.inspecting import looks, picking, selection
from ..plgs_blender.inspecting.picking import hovered
from ..plgs_blender.inspecting.selection import CUT, objects_by_key
from ..plgs_blender.owned import KEY, LIFT, lifts_in, text_of
from .base import CANCELLED, FINISHED, PASSED_ON, argument, reporting


class InView:
    """A mouse operator in a 3D view of a lift, in Object Mode. It has no button."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        in_view = context.area is not None and context.area.type == "VIEW_3D" and context.mode == "OBJECT"
        return in_view and any(len(root.plgs.classes) for root in lifts_in(context.scene))


class PLGS_OT_pick(InView, bpy.types.Operator):
    """Select what is under the mouse: an object by its name, points, splats or surface"""

    bl_idname, bl_label, bl_options = "plgs.pick", "Select Under Mouse", {"UNDO", "INTERNAL"}

    extend: argument(BoolProperty, "Extend", "Add to the selection, or remove from it")

    @reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        keys = context.window_manager.keyconfigs.active.preferences
        if event.type != f"{getattr(keys, 'select_mouse', 'LEFT')}MOUSE":  # not every key map has this setting
            return PASSED_ON
        mouse, layer = _middle_of(event), context.view_layer
        picked = picking.what_is_under(context, mouse)
        if picked is None or (self.extend and not picked.instance):
            return PASSED_ON
        if _is_in_front(context, (event.mouse_region_x, event.mouse_region_y), extend=self.extend):
            return FINISHED
        if picked.instance:
            selection.select_instance(picked.root, picked.instance, layer, extend=self.extend)
        else:
            selection.select_nothing(picked.root, picked.class_id, layer)
        context.area.tag_redraw()
        return FINISHED


def _middle_of(event: bpy.types.Event) -> tuple[float, float]:
    """Return the middle of the pixel under the mouse, in the region."""
    return event.mouse_region_x + 0.5, event.mouse_region_y + 0.5


def _is_in_front(context: bpy.types.Context, mouse: tuple[int, int], *, extend: bool) -> bool:
    """Let Blender select the object at the pixel ``mouse``. Returns whether that object is the user's, a camera or a
    cut. If not, the selection is restored."""
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
    """Return the lift that an object is part of; None for the user's objects and for copies of a lift's objects."""
    if not text_of(ob, LIFT):
        return None
    own = (root for root in lifts_in(scene) if root[LIFT] == ob[LIFT] and ob in objects_by_key(root).values())
    return next(own, None)


class PLGS_OT_point_at(InView, bpy.types.Operator):
    """Show the name of the object under the mouse"""

    bl_idname, bl_label, bl_options = "plgs.point_at", "Name Under Mouse", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        picked = picking.what_is_under(context, _middle_of(event))
        now = [(picked.root.session_uid, picked.instance)] if picked is not None and picked.instance else []
        if now != hovered:
            hovered[:] = now
            context.area.tag_redraw()
        return PASSED_ON


class OnSelected(InView):
    """An operator with a key, on the selected active object of a lift. On other objects, Blender handles the key."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and cls.chosen(context) is not None

    @staticmethod
    def chosen(context: bpy.types.Context) -> tuple[bpy.types.Collection, int] | None:
        """Return the lift and the instance of the active object; None if that is not selected or not of a lift."""
        active = context.active_object
        root = None if active is None else _lift_of(active, context.scene)
        number = 0 if root is None else selection.selected_instance(root, active)
        known = () if root is None else [row.instance_id for row in root.plgs.instances]
        return (root, number) if root is not None and number in known else None


class PLGS_OT_rename_selected(OnSelected, bpy.types.Operator):
    """Rename the active object of the lift"""

    bl_idname, bl_label, bl_options = "plgs.rename_selected", "Rename Object", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        chosen = self.chosen(context)
        if chosen is None:
            return PASSED_ON
        return set(bpy.ops.plgs.rename_instance("INVOKE_DEFAULT", lift=chosen[0].name, instance=chosen[1]))


class PLGS_OT_isolate_selected(OnSelected, bpy.types.Operator):
    """Show only the active object of the lift, and frame it. Again: go back"""

    bl_idname, bl_label, bl_options = "plgs.isolate_selected", "Isolate Object", {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        chosen = self.chosen(context)
        if chosen is None or context.space_data.local_view is not None:  # Blender's own local view comes to an end
            return PASSED_ON
        return set(bpy.ops.plgs.isolate_instance("INVOKE_DEFAULT", lift=chosen[0].name, instance=chosen[1]))


class PLGS_OT_delete_selected(OnSelected, bpy.types.Operator):
    """Hide, dissolve or remove the selected objects of the lift, and hide or delete your own selected objects"""

    bl_idname, bl_label, bl_options = "plgs.delete_selected", "Remove Objects", {"UNDO", "INTERNAL"}

    way: EnumProperty(
        name="Way", options={"SKIP_SAVE"},
        items=[
            ("HIDE", "Hide", "They leave the view. Show All brings back the lift's own, Alt H other objects"),
            ("DISSOLVE", "Dissolve into Surroundings", "They stay visible, as part of what is around them"),
            ("REMOVE", "Remove (Clean Plate)", "They are gone, and what was behind them is drawn instead"),
        ],
    )  # fmt: skip

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        def ask(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
            menu.layout.operator_context = "EXEC_DEFAULT"  # else `invoke` would open the menu again
            menu.layout.operator_enum(self.bl_idname, "way")

        context.window_manager.popup_menu(ask, title=self.bl_label)
        return {"INTERFACE"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        chosen = self.chosen(context)
        if chosen is None:
            return CANCELLED
        root, active = chosen
        names = {row.instance_id: row.name for row in root.plgs.instances}
        numbers = selection.selected_instances(root, context.view_layer) or [active]
        numbers = [number for number in numbers if number in names]
        if self.way == "HIDE":
            theirs = [ob for ob in context.selected_objects if _lift_of(ob, context.scene) is None]
            looks.hide(root, numbers)
            for ob in theirs:
                ob.hide_set(True)
            self.report({"INFO"}, one_line(f"Hidden: {', '.join(names[number] for number in numbers)}"))
            return FINISHED
        if self.way == "REMOVE":
            named = " ".join(map(str, numbers))
            return set(bpy.ops.plgs.remove_instances("INVOKE_DEFAULT", lift=root.name, instances=named))
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
        self.report({"INFO"}, one_line(f"Dissolved: {', '.join(names[number] for number in numbers)}{stays}"))
        return FINISHED


_KEYS: tuple[tuple[str, str, str, dict[str, Any], dict[str, Any]], ...] = (
    ("plgs.point_at", "MOUSEMOVE", "ANY", {}, {}),
    ("plgs.pick", "LEFTMOUSE", "CLICK", {}, {}),
    ("plgs.pick", "LEFTMOUSE", "CLICK", {"shift": True}, {"extend": True}),
    ("plgs.pick", "RIGHTMOUSE", "PRESS", {}, {}),
    ("plgs.pick", "RIGHTMOUSE", "PRESS", {"shift": True}, {"extend": True}),
    ("plgs.rename_selected", "F2", "PRESS", {}, {}),
    ("plgs.isolate_selected", "SLASH", "PRESS", {}, {}),
    ("plgs.isolate_selected", "NUMPAD_SLASH", "PRESS", {}, {}),
    ("plgs.delete_selected", "X", "PRESS", {}, {}),
    ("plgs.delete_selected", "DEL", "PRESS", {}, {}),
    ("plgs.quit", "Q", "PRESS", {"ctrl": True}, {}),
)
"""Operator, key, event, modifiers, and the operator's properties; in Object Mode, except Quit, which works anywhere."""
_added: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


def register() -> None:
    """Add the keys where the preferences list them for editing. Blender without a window has no key maps."""
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is None:
        return
    for operator, key, event, modifiers, given in _KEYS:
        keymap = keys.keymaps.new("Window" if operator == "plgs.quit" else "Object Mode", space_type="EMPTY")
        item = keymap.keymap_items.new(operator, key, event, **modifiers)
        for name, value in given.items():
            setattr(item.properties, name, value)
        _added.append((keymap, item))


def unregister() -> None:
    while _added:
        keymap, item = _added.pop()
        keymap.keymap_items.remove(item)
