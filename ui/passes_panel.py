"""The panels "4 Passes": the panoptic layers of more frames, for the compositor; and "5 Export": files for other
programs, and meshes."""

from __future__ import annotations

import bpy

from ..plgs_blender import registry
from ..plgs_blender.compositing import panoptic_of
from ..plgs_blender.errors import one_line
from ..plgs_blender.inspecting.selection import active_lift
from ..plgs_blender.meshes import SURFACE
from ..plgs_blender.owned import scene_to_fill
from ..plgs_blender.pass_nodes import COLOURS, CONTROLS
from ..plgs_blender.running.estimate import bake_estimate
from ..plgs_blender.running.exports import FORMS, Export
from ..plgs_blender.running.lifting import followed_lift
from . import sidebar


class PLGS_PT_passes(sidebar.Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_passes", "4  Passes", 40

    def draw(self, context: bpy.types.Context) -> None:
        followed = followed_lift(context.scene.plgs)
        baking = followed if followed is not None and followed.is_baking else None
        row = self.layout.row(align=True)
        row.label(text="Also")
        row.prop(context.scene.plgs, "layers")
        column = sidebar.from_panel(self.layout.column(align=True), context)
        for frames, label in (("all", "All Frames"), ("test", "Check Frames"), ("active", "the Active Camera's Frame")):
            column.operator("plgs.bake_passes", text=f"Bake {label}", icon="RENDERLAYERS").frames = frames
        row = column.row(align=True)
        row.prop(context.scene.plgs, "shot")
        row.prop(context.scene.plgs, "replace_shot", toggle=True)
        bake = column.operator("plgs.bake_camera", icon="CAMERA_DATA")
        bake.shot, bake.replace = context.scene.plgs.shot, context.scene.plgs.replace_shot
        column.operator("plgs.bake_on_farm", icon="NETWORK_DRIVE")
        if sidebar.has_result(context.scene):
            _draw_cost(column, context.scene)
        self.layout.operator("plgs.show_passes", icon="NODE_COMPOSITING")
        if baking is not None and (baking.is_running or baking.error is not None):
            sidebar.draw_task(self.layout, context, baking)  # below the buttons, so that they do not move
        elif baking is not None:
            sidebar.draw_text(self.layout, context, baking.message, "INFO")


class PLGS_PT_panoptic(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "Matte in the Compositor", "PLGS_PT_passes", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        node = panoptic_of(context.scene)
        if node is None:
            what_to_do = "Bake passes first, then choose a matte with a button Matte of the result"
            sidebar.draw_text(layout, context, what_to_do, "INFO")
            return
        layout.use_property_split, layout.use_property_decorate = True, False
        root = active_lift(scene_to_fill(context.scene), context.active_object)
        if root is not None:
            layout.prop(root.plgs, "matte_follows")
        for name in (*CONTROLS, *COLOURS):
            layout.prop(node.inputs[name], "default_value", text=name)


def _draw_cost(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    render, camera = scene.render, scene.camera
    width, height = (side * render.resolution_percentage // 100 for side in (render.resolution_x, render.resolution_y))
    frames = len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    cost = bake_estimate(frames, (width, height), scene.plgs.layers)
    layout.label(text=f"{'No camera' if camera is None else one_line(camera.name)}: {width} x {height}", icon="BLANK1")
    layout.label(text=f"Frames {scene.frame_start} to {scene.frame_end}, {sidebar.amount(cost.bytes)}", icon="BLANK1")
    layout.label(text=f"About {sidebar.duration(cost.seconds)}", icon="BLANK1")


class PLGS_PT_export(sidebar.Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order, bl_options = "PLGS_PT_export", "5  Export", 50, {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel. A running export's bar replaces its button; its messages come below all buttons."""
        layout, export = self.layout, registry.latest(Export)
        running = export if export is not None and export.is_running else None
        scene = running.form if running is not None and running.is_for_scene else ""
        row = layout.row(align=True)
        if not sidebar.draw_bar(row, running if scene == SURFACE else None, "Meshes"):
            row.operator("plgs.make_meshes", icon="MESH_DATA")
        row = layout.row(align=True)
        row.operator("plgs.make_objects", icon="OUTLINER_COLLECTION")
        row.operator("plgs.make_objects", text="As Assets", icon="ASSET_MANAGER").as_assets = True
        row = layout.split(factor=0.5, align=True)
        row.operator("plgs.key_visibility", icon="KEY_HLT")
        cell = row.row(align=True)
        if not sidebar.draw_bar(cell, running if scene == "clouds" else None, "Cloud"):
            cell.operator("plgs.make_depth_cloud", icon="OUTLINER_DATA_POINTCLOUD")
        _draw_shown(layout.row(align=True))
        _draw_forms(layout.column(align=True), None if scene else running)
        sidebar.draw_lacking(layout, context, "usd")
        if running is not None:
            sidebar.draw_text(layout, context, sidebar.how_far(running)[1], "TIME")
        if export is not None:
            sidebar.draw_news(layout, context, export)
            if not export.is_running and export.error is None:
                sidebar.draw_text(layout, context, export.message, "INFO")


class PLGS_MT_export(bpy.types.Menu):
    bl_idname, bl_label = "PLGS_MT_export", "PLGS Lift"

    def draw(self, context: bpy.types.Context) -> None:
        _draw_shown(self.layout)
        _draw_forms(self.layout)


def _draw_shown(layout: bpy.types.UILayout) -> None:
    """Draw the formats that Blender writes itself from what is shown."""
    layout.operator_context = "INVOKE_DEFAULT"
    for form, label in (("gltf", "glTF…"), ("usd", "OpenUSD…")):
        layout.operator("plgs.export_shown", text=label, icon="EXPORT").form = form


def _draw_forms(layout: bpy.types.UILayout, running: Export | None = None) -> None:
    layout.operator_context = "INVOKE_DEFAULT"
    for form, (label, _) in FORMS.items():
        cell = layout.row(align=True)
        if running is None or running.form != form or not sidebar.draw_bar(cell, running, label):
            cell.operator("plgs.export_lift", text=f"{label}…").form = form


def _in_file_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.menu(PLGS_MT_export.bl_idname)


MENUS = (("TOPBAR_MT_file_export", "append", _in_file_menu),)
