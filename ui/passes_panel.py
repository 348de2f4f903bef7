"""4 Passes: bake the panoptic layers of more frames, and take them to the compositor."""

from __future__ import annotations

import bpy

from .sidebar import Step, from_panel


class PLGS_PT_passes(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_passes", "4  Passes", 4

    def draw(self, context: bpy.types.Context) -> None:
        column = from_panel(self.layout.column(align=True), context)
        for frames, label in (("all", "Bake All Frames"), ("active", "Bake the Active Camera's Frame")):
            column.operator("plgs.bake_passes", text=label, icon="RENDERLAYERS").frames = frames
        self.layout.operator("plgs.show_passes", icon="NODE_COMPOSITING")


CLASSES = (PLGS_PT_passes,)
