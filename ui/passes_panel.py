"""4 Passes: bake the panoptic layers of more frames, and take them to the compositor."""

from __future__ import annotations

import bpy

from ..plgs_blender.errors import one_line
from ..plgs_blender.mattes import panoptic_of
from ..plgs_blender.panoptic_group import COLOURS, CONTROLS
from ..plgs_blender.running.estimate import bake_estimate
from ..plgs_blender.running.lifting import followed_lift
from .sidebar import Sidebar, Step, amount, draw_task, duration, from_panel, tell


class PLGS_PT_passes(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_passes", "4  Passes", 4

    def draw(self, context: bpy.types.Context) -> None:
        followed = followed_lift(context.scene.plgs)
        baking = followed if followed is not None and followed.is_baking else None
        row = self.layout.row(align=True)
        row.label(text="Also")
        row.prop(context.scene.plgs, "layers")
        column = from_panel(self.layout.column(align=True), context)
        for frames, label in (
            ("all", "Bake All Frames"),
            ("test", "Bake Held-Out Frames"),
            ("active", "Bake the Active Camera's Frame"),
        ):
            column.operator("plgs.bake_passes", text=label, icon="RENDERLAYERS").frames = frames
        row = column.row(align=True)
        row.prop(context.scene.plgs, "shot")
        row.prop(context.scene.plgs, "replace_shot", toggle=True)
        bake = column.operator("plgs.bake_camera", icon="CAMERA_DATA")
        bake.shot, bake.replace = context.scene.plgs.shot, context.scene.plgs.replace_shot
        column.operator("plgs.bake_on_farm", icon="NETWORK_DRIVE")
        _draw_cost(column, context.scene)
        self.layout.operator("plgs.show_passes", icon="NODE_COMPOSITING")
        if baking is not None and (baking.is_running or baking.error is not None):
            draw_task(self.layout, context, baking)  # below the buttons, which are grey until it ends
        elif baking is not None:
            tell(self.layout, context, baking.message, "INFO")


class PLGS_PT_panoptic(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_panoptic", "Matte in the Compositor"
    bl_parent_id, bl_options = "PLGS_PT_passes", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        node = panoptic_of(context.scene)
        if node is None:
            tell(layout, context, "Bake passes first; a result's Matte button then chooses the matte", "INFO")
            return
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in (*(control.name for control in CONTROLS), *COLOURS):
            layout.prop(node.inputs[name], "default_value", text=name)


def _draw_cost(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Say which camera would be baked, over which frames, at which size, and what that costs at most."""
    render, camera = scene.render, scene.camera
    width, height = (side * render.resolution_percentage // 100 for side in (render.resolution_x, render.resolution_y))
    frames = len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    cost = bake_estimate(frames, (width, height), scene.plgs.layers)
    layout.label(text=f"{'No camera' if camera is None else one_line(camera.name)}: {width} x {height}", icon="BLANK1")
    layout.label(text=f"Frames {scene.frame_start} to {scene.frame_end}, {amount(cost.bytes)}", icon="BLANK1")
    layout.label(text=f"About {duration(cost.seconds)}", icon="BLANK1")


CLASSES = (PLGS_PT_passes, PLGS_PT_panoptic)
