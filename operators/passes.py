"""Baking panoptic passes of a finished lift, and using them."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty

from ..plgs_blender import passes_view
from ..plgs_blender.running import start
from ..plgs_blender.running.lifts import Watch
from .answers import FINISHED, panel_of, reporting
from .lift import Following, OnLiftFolder

_FRAMES = [
    ("all", "All frames", "Bake every frame that has no passes yet"),
    ("test", "Held-out frames", "Bake the frames that were held out of training"),
    ("active", "Active camera", "Bake the frame whose camera is the scene's active one"),
]


class PLGS_OT_bake_passes(OnLiftFolder, Following, bpy.types.Operator):
    """Render colour, depth, class, instance, confidence and Cryptomatte layers of a finished lift, in the background"""

    bl_idname, bl_label = "plgs.bake_passes", "Bake Passes"

    frames: EnumProperty(  # type: ignore[valid-type]
        name="Frames", items=_FRAMES, default="all", options={"SKIP_SAVE"}, description="Which frames to bake"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        panel = panel_of(context)
        reason = start.why_no_engine() or (None if panel is None else start.why_no_bake(panel))
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    def begin(self, context: bpy.types.Context) -> Watch:
        return start.bake_passes(context.scene, self.frames, self.lift_folder)


class PLGS_OT_show_passes(bpy.types.Operator):
    """Open the scene whose compositor holds the passes, at the view of the active camera"""

    bl_idname, bl_label, bl_options = "plgs.show_passes", "Open in Compositor", {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("This scene has no lift with passes: bake them first")
        return passes_view.passes_scene_of(context.scene) is not None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        target = passes_view.open_passes(context.scene)
        if context.window is not None:
            context.window.scene = target
        return FINISHED


CLASSES = (PLGS_OT_bake_passes, PLGS_OT_show_passes)
