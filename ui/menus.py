"""The menus of a lift: in the Object menu, where F3 finds them, and in the context menus of objects and rows."""

from __future__ import annotations

from typing import Any

import bpy

from ..plgs_blender.errors import one_line
from ..plgs_blender.inspecting.selection import active_lift, chosen_row, instance_of

Entries = tuple[str | tuple[str, dict[str, Any], str], ...]
"""Our operators, perhaps with properties and a label; an empty label means the operator's own."""

_OBJECT: Entries = (
    "frame_instance", "isolate_instance", "toggle_instance_visibility", "go_to_best_view",
    ("matte_instance", {}, "Use Object as Matte"),
    "rename_instance", "reclass_instances", "merge_instances",
    ("split_instance", {"by": "PARTS"}, "Split into Connected Parts"),
    "split_by_views", "place_cut",
    ("split_instance", {"by": "CUT"}, "Split by Cutting Plane"),
    "crop_instance",
    ("assign_points", {"to": "INSTANCE"}, "Paint Points of the Object"),
    ("accept_instances", {}, "Accept as Correct"),
    "make_objects",
    ("make_objects", {"as_assets": True}, "Make Assets"),
    "key_visibility",
    ("delete_instance", {"becomes": "AROUND"}, "Dissolve into Surroundings"),
    "remove_instances", "put_back",
)  # fmt: skip
_RESULT: Entries = (
    "show_all", "show_colours",
    *(("show_as", {"kind": kind}, f"Show as {kind.capitalize()}") for kind in ("POINTS", "SPLATS", "SURFACE")),
    "propose_corrections",
    ("go_to_proposal", {}, "Look at the Proposal"),
    ("answer_proposal", {}, "Apply the Proposal"),
    ("answer_proposal", {"keep": True}, "Keep the Object as It Is"),
    "next_uncertain_frame", "undo_correction",
)  # fmt: skip
_WORK: Entries = (
    "import_scene", "try_sample",
    *(("show_picture", {"what": what}, f"Show {what.capitalize()} of the Frame")
      for what in ("PHOTO", "DEPTH", "MASKS")),
    ("import_film", {}, "Lift a Film…"), "make_poses", "make_depth", "set_scale", "measure", "make_masks",
    ("make_masks", {"every": True}, "Make Masks of All Frames"),
    "read_classes", "write_classes", "diagnose",
    ("fix_scene", {}, "Fix Diagnosed Problems"),
    ("lift_scene", {}, "Start the Lift"),
    ("resume_lift", {}, "Resume the Lift"),
    ("refine_lift", {}, "Refine the Draft"),
    ("cancel_lift", {}, "Cancel the Lift"),
    ("open_lift", {}, "Open Lift…"),
    ("find_lift", {}, "Find the Lift…"),
    ("find_scene", {}, "Find the Lift's Scene…"),
    "place_lift",
    *(("bake_passes", {"frames": frames}, f"Bake Passes: {text}")
      for frames, text in (("all", "All Frames"), ("test", "Check Frames"), ("active", "Active Camera's Frame"))),
    "bake_camera", "bake_on_farm", "show_passes", "show_room", "make_meshes", "make_depth_cloud",
    ("show_preferences", {}, "PLGS Preferences"),
)  # fmt: skip


class OfEntries:
    """A menu of operators that open dialogs for their options."""

    entries: Entries
    layout: bpy.types.UILayout

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.operator_context = "INVOKE_DEFAULT"
        for entry in self.entries:
            name, given, text = (entry, {}, "") if isinstance(entry, str) else entry
            chosen = self.layout.operator(f"plgs.{name}", **({"text": text} if text else {}))
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
    for each in (PLGS_MT_object, PLGS_MT_result, PLGS_MT_work):
        menu.layout.menu(each.bl_idname)


def _at_object(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    if instance_of(context.active_object):
        _draw_named(menu, context)
        menu.layout.separator()


def _at_row(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    rows = getattr(context, "ui_list", None)
    if rows is not None and rows.bl_idname == "PLGS_UL_instances":
        menu.layout.separator()
        _draw_named(menu, context)


def _draw_named(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    row = chosen_row(context.scene, context.active_object)
    if row is not None:
        menu.layout.menu(PLGS_MT_object.bl_idname, text=one_line(row.name))


MENUS = (
    ("VIEW3D_MT_object", "append", _in_object_menu),
    ("VIEW3D_MT_object_context_menu", "prepend", _at_object),
    ("OUTLINER_MT_object", "prepend", _at_object),
    ("UI_MT_list_item_context_menu", "append", _at_row),
)
