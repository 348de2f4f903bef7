"""5 Export: the lift in formats that other programs read, and its meshes in the scene; also in File > Export."""

from __future__ import annotations

from typing import Any

import bpy

from ..plgs_blender.meshes import SURFACE
from ..plgs_blender.running.exports import FORMS, Export
from ..plgs_blender.tasks import registry
from .sidebar import Step, draw_bar, draw_news, how_far, tell


class PLGS_PT_export(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order, bl_options = "PLGS_PT_export", "5  Export", 5, {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """The export that runs has its bar where its button was; what it tells comes below all buttons."""
        layout, export = self.layout, registry.latest(Export)
        running = export if export is not None and export.is_running else None
        scene = running.form if running is not None and running.is_for_scene else ""
        row = layout.row(align=True)
        if running is not None and scene == SURFACE:
            draw_bar(row, running, "Meshes")
        else:
            row.operator("plgs.make_meshes", icon="MESH_DATA")
        row = layout.row(align=True)
        row.operator("plgs.make_objects", icon="OUTLINER_COLLECTION")
        row.operator("plgs.make_objects", text="As Assets", icon="ASSET_MANAGER").as_assets = True
        row = layout.split(factor=0.5, align=True)
        row.operator("plgs.key_visibility", icon="KEY_HLT")
        cell = row.row(align=True)
        if running is not None and scene == "clouds":
            draw_bar(cell, running, "Cloud")
        else:
            cell.operator("plgs.make_depth_cloud", icon="OUTLINER_DATA_POINTCLOUD")
        _draw_forms(layout.column(align=True), None if scene else running)
        if running is not None:
            tell(layout, context, how_far(running)[1], "TIME")
        if export is not None:
            draw_news(layout, context, export)
            if not export.is_running and export.error is None:
                tell(layout, context, export.message, "INFO")


class PLGS_MT_export(bpy.types.Menu):
    bl_idname, bl_label = "PLGS_MT_export", "PLGS Lift"

    def draw(self, context: bpy.types.Context) -> None:
        _draw_forms(self.layout)


def _draw_forms(layout: bpy.types.UILayout, running: Export | None = None) -> None:
    layout.operator_context = "INVOKE_DEFAULT"
    for form, (label, _) in FORMS.items():
        cell = layout.row(align=True)
        if running is not None and running.form == form:
            draw_bar(cell, running, label)
        else:
            cell.operator("plgs.export_lift", text=f"{label}…").form = form


def _in_file_menu(menu: Any, context: bpy.types.Context) -> None:
    menu.layout.menu(PLGS_MT_export.bl_idname)


CLASSES = (PLGS_PT_export, PLGS_MT_export)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_in_file_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_in_file_menu)
