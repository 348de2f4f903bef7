"""5 Export: the lift in formats that other programs read, and its meshes in the scene; also in File > Export."""

from __future__ import annotations

from typing import Any

import bpy

from ..plgs_blender.running.exports import FORMS, Export, is_busy
from ..plgs_blender.tasks import registry
from .sidebar import Step, draw_task, tell


class PLGS_PT_export(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order, bl_options = "PLGS_PT_export", "5  Export", 5, {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, export = self.layout, registry.latest(Export)
        if export is not None and is_busy():
            draw_task(layout, context, export)
            return
        layout.operator("plgs.make_meshes", icon="MESH_DATA")
        row = layout.row(align=True)
        row.operator("plgs.make_objects", icon="OUTLINER_COLLECTION")
        row.operator("plgs.make_objects", text="As Assets", icon="ASSET_MANAGER").as_assets = True
        row = layout.row(align=True)
        row.operator("plgs.key_visibility", icon="KEY_HLT")
        row.operator("plgs.make_depth_cloud", icon="OUTLINER_DATA_POINTCLOUD")
        _draw_forms(layout.column(align=True))
        if export is not None:
            draw_task(layout, context, export)
            if export.error is None:
                tell(layout, context, export.message, "INFO")


class PLGS_MT_export(bpy.types.Menu):
    bl_idname, bl_label = "PLGS_MT_export", "PLGS Lift"

    def draw(self, context: bpy.types.Context) -> None:
        _draw_forms(self.layout)


def _draw_forms(layout: bpy.types.UILayout) -> None:
    layout.operator_context = "INVOKE_DEFAULT"
    for form, (label, _) in FORMS.items():
        layout.operator("plgs.export_lift", text=f"{label} ...").form = form


def _in_file_menu(menu: Any, context: bpy.types.Context) -> None:
    menu.layout.menu(PLGS_MT_export.bl_idname)


CLASSES = (PLGS_PT_export, PLGS_MT_export)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_in_file_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_in_file_menu)
