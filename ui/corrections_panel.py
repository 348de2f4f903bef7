"""The panel "Correct": buttons for correcting a lift's objects, below its list."""

from __future__ import annotations

import bpy

from ..plgs_blender import corrections, registry
from ..plgs_blender.correction_tools import RemoveObjects, SplitByViews
from ..plgs_blender.errors import EXPECTED, one_line, plural
from ..plgs_blender.inspecting.looks import SURFACE, has
from ..plgs_blender.inspecting.selection import active_lift, chosen_row
from ..plgs_blender.meshes import are_stale
from ..plgs_blender.proposals import kept_proposals
from ..plgs_blender.running.exports import making_meshes
from .result_panel import OfResult
from .sidebar import draw_bar, draw_task, draw_text, from_panel

_SHOWN = 4  # number of proposals shown at a time


class PLGS_PT_corrections(OfResult, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_corrections", "Correct"

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """Show what the key X or a menu began, also while the panel is closed."""
        for kind, name in ((RemoveObjects, "Removing"), (SplitByViews, "Views")):
            task = registry.latest(kind)
            if not draw_bar(self.layout, task, name) and task is not None and task.error is not None:
                self.layout.label(icon="ERROR")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel. Results of an engine or an edit come below the buttons, which therefore never move."""
        root = active_lift(context.scene, context.active_object)
        layout = from_panel(self.layout.column(), context)
        column = layout.column(align=True)
        row = column.row(align=True)
        row.operator("plgs.rename_instance", text="Rename", icon="GREASEPENCIL")
        row.operator("plgs.reclass_instances", icon="TAG")
        row = column.row(align=True)
        row.operator("plgs.merge_instances", icon="AUTOMERGE_ON")
        row.operator("plgs.delete_instance", text="Dissolve", icon="TRASH").becomes = "AROUND"
        removal, cell = registry.latest(RemoveObjects), column.row(align=True)
        if not draw_bar(cell, removal, "Removing"):
            cell.operator("plgs.remove_instances", icon="SELECT_SUBTRACT")
        row = layout.split(factor=0.45, align=True)
        row.operator("plgs.split_instance", text="Split Parts", icon="MOD_EXPLODE").by = "PARTS"
        split, cell = registry.latest(SplitByViews), row.row(align=True)
        if not draw_bar(cell, split, "Views"):
            cell.operator("plgs.split_by_views", text="Split by Views", icon="CAMERA_STEREO")
        row = layout.row(align=True)
        row.operator("plgs.place_cut", text="Add Plane", icon="MESH_PLANE")
        row.operator("plgs.split_instance", text="Split", icon="MOD_BOOLEAN").by = "CUT"
        row = layout.split(factor=0.28, align=True)
        row.operator("plgs.assign_points", text="Paint", icon="BRUSH_DATA").to = "INSTANCE"
        row = row.split(factor=0.6, align=True)  # each button is as wide as its label
        row.menu(PLGS_MT_paint_new.bl_idname)
        row.menu(PLGS_MT_paint_class.bl_idname)
        layout.operator("plgs.crop_instance", icon="CUBE")
        row = layout.row(align=True)
        row.operator("plgs.accept_instances", icon="CHECKMARK")
        row.operator("plgs.undo_correction", text="Undo Last", icon="LOOP_BACK")
        if root is not None:
            shown = len(str(root.get(corrections.EDITS, "")).split())
            summary = f"{plural(shown, 'correction')}; bake again to update passes" if shown else "No corrections"
            draw_text(layout, context, summary)
            if has(root, SURFACE) and are_stale(root):
                row = layout.row(align=True)
                if not draw_bar(row, making_meshes(), "Surface"):
                    row.operator("plgs.make_meshes", text="Update Surface", icon="FILE_REFRESH")
        for task in (split, removal):
            if task is not None and not task.is_running:
                draw_task(layout, context, task)
        for number, name in corrections.removed_objects(root).items() if root is not None else ():
            row = self.layout.row(align=True)
            row.label(text=one_line(name), icon="X")
            row.operator("plgs.make_objects", text="", icon="OUTLINER_COLLECTION").instances = str(number)
            row.operator("plgs.put_back", icon="LOOP_BACK").instance = number
        if root is not None:
            _draw_proposals(self.layout.column(), context, root)


def _draw_proposals(layout: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Collection) -> None:
    """Draw the most doubtful objects, each with its reason and a button for each answer."""
    found, progress = kept_proposals(root)
    layout.operator("plgs.propose_corrections", text=one_line(progress) or "What May Be Wrong?", icon="VIEWZOOM")
    layout.operator("plgs.next_uncertain_frame", icon="CAMERA_DATA")
    for one in found[:_SHOWN]:
        box = layout.box().column(align=True)
        draw_text(box, context, f"{one.name}: {one.reason}")
        look = box.operator("plgs.go_to_proposal", icon="VIEW_CAMERA")
        row = box.row(align=True)
        do = row.operator("plgs.answer_proposal", text=one_line(one.answer).capitalize())
        keep = row.operator("plgs.answer_proposal", text="Keep")
        look.instance = do.instance = keep.instance = one.instance
        keep.keep = True


class OfClasses:
    """A menu of the lift's classes, one of which painted points shall get."""

    to: str
    layout: bpy.types.UILayout

    def draw(self, context: bpy.types.Context) -> None:
        root, chosen = (find(context.scene, context.active_object) for find in (active_lift, chosen_row))
        if root is None:
            return
        try:
            names = corrections.class_choices(root, 0 if chosen is None else chosen.instance_id)
        except EXPECTED as error:
            self.layout.label(text=one_line(error), icon="ERROR")
            return
        self.layout.operator_context = "INVOKE_DEFAULT"
        for name in names:
            paint = self.layout.operator("plgs.assign_points", text=one_line(name))
            paint.to, paint.class_name = self.to, name


class PLGS_MT_paint_new(OfClasses, bpy.types.Menu):
    """Paint the points of a new object"""

    bl_idname, bl_label, to = "PLGS_MT_paint_new", "New Object", "NEW"


class PLGS_MT_paint_class(OfClasses, bpy.types.Menu):
    """Paint points of a class that belong to no object"""

    bl_idname, bl_label, to = "PLGS_MT_paint_class", "Class", "CLASS"
