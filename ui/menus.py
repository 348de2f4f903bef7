"""A lift's menus: in the Object menu, where F3 finds them, and in the context menus of objects and rows."""

from __future__ import annotations

from typing import Any

import bpy

from ..plgs_blender.errors import one_line
from ..plgs_blender.inspecting.selection import active_lift, chosen_row, instance_of

Entries = tuple[tuple[str, dict[str, Any], str], ...]
"""Operators, their properties and their labels; an empty label means the operator's own."""

_OBJECT: Entries = (
    ("plgs.frame_instance", {}, ""),
    ("plgs.isolate_instance", {}, ""),
    ("plgs.toggle_instance_visibility", {}, ""),
    ("plgs.go_to_best_view", {}, ""),
    ("plgs.matte_instance", {}, "Use Object as Matte"),
    ("plgs.rename_instance", {}, ""),
    ("plgs.reclass_instances", {}, ""),
    ("plgs.merge_instances", {}, ""),
    ("plgs.split_instance", {"by": "PARTS"}, "Split into Connected Parts"),
    ("plgs.split_by_views", {}, ""),
    ("plgs.place_cut", {}, ""),
    ("plgs.split_instance", {"by": "CUT"}, "Split by Cutting Plane"),
    ("plgs.crop_instance", {}, ""),
    ("plgs.assign_points", {"to": "INSTANCE"}, "Paint Points of the Object"),
    ("plgs.accept_instances", {}, "Accept as Correct"),
    ("plgs.make_objects", {}, ""),
    ("plgs.make_objects", {"as_assets": True}, "Make Assets"),
    ("plgs.key_visibility", {}, ""),
    ("plgs.delete_instance", {"becomes": "AROUND"}, "Dissolve into Surroundings"),
)
_RESULT: Entries = (
    ("plgs.show_all", {}, ""),
    ("plgs.show_colours", {}, ""),
    *(("plgs.show_as", {"kind": kind}, f"Show as {kind.capitalize()}") for kind in ("POINTS", "SPLATS", "SURFACE")),
    ("plgs.propose_corrections", {}, ""),
    ("plgs.go_to_proposal", {}, "Look at the Proposal"),
    ("plgs.answer_proposal", {}, "Apply the Proposal"),
    ("plgs.answer_proposal", {"keep": True}, "Keep the Object as It Is"),
    ("plgs.next_uncertain_frame", {}, ""),
    ("plgs.undo_correction", {}, ""),
)  # fmt: skip
_WORK: Entries = (
    ("plgs.import_scene", {}, ""),
    *(("plgs.show_picture", {"what": what}, f"Show {what.capitalize()} of the Frame")
       for what in ("PHOTO", "DEPTH", "MASKS")),
    ("plgs.make_poses", {}, ""),
    ("plgs.make_masks", {}, ""),
    ("plgs.read_classes", {}, ""),
    ("plgs.write_classes", {}, ""),
    ("plgs.diagnose", {}, ""),
    ("plgs.fix_scene", {}, "Fix Diagnosed Problems"),
    ("plgs.lift_scene", {}, "Start the Lift"),
    ("plgs.resume_lift", {}, "Resume the Lift"),
    ("plgs.cancel_lift", {}, "Cancel the Lift"),
    ("plgs.open_lift", {}, "Open Lift…"),
    ("plgs.find_scene", {}, "Find the Lift's Scene…"),
    ("plgs.place_lift", {}, ""),
    *((("plgs.bake_passes", {"frames": frames}, f"Bake Passes: {text}")
       for frames, text in (("all", "All Frames"), ("test", "Test Frames"), ("active", "Active Camera's Frame")))),
    ("plgs.bake_camera", {}, ""),
    ("plgs.bake_on_farm", {}, ""),
    ("plgs.show_passes", {}, ""),
    ("plgs.show_room", {}, ""),
    ("plgs.make_meshes", {}, ""),
    ("plgs.make_depth_cloud", {}, ""),
    ("plgs.show_preferences", {}, "PLGS Preferences"),
)  # fmt: skip


class OfEntries:
    """A menu of operators that open dialogs for their options."""

    entries: Entries
    layout: bpy.types.UILayout

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.operator_context = "INVOKE_DEFAULT"
        for name, given, text in self.entries:
            chosen = self.layout.operator(name, **({"text": text} if text else {}))
            for each, value in given.items():
                setattr(chosen, each, value)


class PLGS_MT_object(OfEntries, bpy.types.Menu):
    """Actions on the active object of a lift"""

    bl_idname, bl_label, entries = "PLGS_MT_object", "Lifted Object", _OBJECT


class PLGS_MT_result(OfEntries, bpy.types.Menu):
    """How a lift is shown, and what may be wrong with it"""

    bl_idname, bl_label, entries = "PLGS_MT_result", "Lift", _RESULT

    def draw(self, context: bpy.types.Context) -> None:
        super().draw(context)
        root = active_lift(context.scene, context.active_object)
        if root is not None:
            self.layout.props_enum(root.plgs, "look")
            for name in ("show_labels", "show_legend", "show_selected"):
                self.layout.prop(root.plgs, name)


class PLGS_MT_work(OfEntries, bpy.types.Menu):
    """From a capture to passes and meshes"""

    bl_idname, bl_label, entries = "PLGS_MT_work", "Lift Panoptic Masks", _WORK


def _in_object_menu(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    menu.layout.separator()
    for each in CLASSES:
        menu.layout.menu(each.bl_idname)


def _at_object(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    """Draw the active object's menu before Blender's own entries."""
    if instance_of(context.active_object):
        _draw_named(menu, context)
        menu.layout.separator()


def _at_row(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    """Draw the row's menu in the list of instances."""
    rows = getattr(context, "ui_list", None)
    if rows is not None and rows.bl_idname == "PLGS_UL_instances":
        menu.layout.separator()
        _draw_named(menu, context)


def _draw_named(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    row = chosen_row(context.scene, context.active_object)
    if row is not None:
        menu.layout.menu(PLGS_MT_object.bl_idname, text=one_line(row.name))


CLASSES = (PLGS_MT_object, PLGS_MT_result, PLGS_MT_work)
MENUS = (
    ("VIEW3D_MT_object", "append", _in_object_menu),
    ("VIEW3D_MT_object_context_menu", "prepend", _at_object),
    ("OUTLINER_MT_object", "prepend", _at_object),
    ("UI_MT_list_item_context_menu", "append", _at_row),
)
