"""4 Passes: bake the panoptic layers of more frames, and take them to the compositor."""

from __future__ import annotations

import bpy

from ..plgs_blender.inspecting.lookup import active_lift
from ..plgs_blender.mattes import panoptic_of
from ..plgs_blender.panoptic_group import COLOURS, CONTROLS
from .sidebar import Sidebar, Step, from_panel, tell


class PLGS_PT_passes(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_passes", "4  Passes", 4

    def draw(self, context: bpy.types.Context) -> None:
        column = from_panel(self.layout.column(align=True), context)
        for frames, label in (
            ("all", "Bake All Frames"),
            ("test", "Bake Held-out Frames"),
            ("active", "Bake the Active Camera's Frame"),
        ):
            column.operator("plgs.bake_passes", text=label, icon="RENDERLAYERS").frames = frames
        scene = context.scene
        column.operator("plgs.bake_camera", icon="CAMERA_DATA")
        column.label(text=f"Frames {scene.frame_start} to {scene.frame_end}, {_size(scene.render)}")
        self.layout.operator("plgs.show_passes", icon="NODE_COMPOSITING")


class PLGS_PT_panoptic(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_panoptic", "Matte in the Compositor"
    bl_parent_id, bl_options = "PLGS_PT_passes", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = active_lift(context.scene, context.active_object)
        node = panoptic_of(root) if root is not None else None
        if node is None:
            tell(layout, context, "Bake passes first; a result's Matte button then chooses the matte.", "INFO")
            return
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in (*(control.name for control in CONTROLS), *COLOURS):
            layout.prop(node.inputs[name], "default_value", text=name)


def _size(render: bpy.types.RenderSettings) -> str:
    """The size of the pictures in pixels, such as "1920 x 1080"."""
    sides = (side * render.resolution_percentage // 100 for side in (render.resolution_x, render.resolution_y))
    return " x ".join(map(str, sides))


CLASSES = (PLGS_PT_passes, PLGS_PT_panoptic)
