"""Baking panoptic passes of a finished lift, and using them."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender import passes_view
from ..plgs_blender.running import start
from ..plgs_blender.running.lifts import Watch
from .answers import FINISHED, reporting
from .lift import Following

_FRAMES = [
    ("all", "All frames", "Bake every frame that has no passes yet"),
    ("test", "Held-out frames", "Bake the frames that were held out of training"),
    ("active", "Active camera", "Bake the frame whose camera is the scene's active one"),
]


class PLGS_OT_bake_passes(Following, bpy.types.Operator):
    """Render colour, depth, class, instance, confidence and Cryptomatte layers of a finished lift, in the background"""

    bl_idname, bl_label = "plgs.bake_passes", "Bake Passes"

    frames: EnumProperty(name="Frames", items=_FRAMES, default="all")  # type: ignore[valid-type]
    lift_folder: StringProperty(  # type: ignore[valid-type]
        name="Lift folder", subtype="DIR_PATH", description="Empty: the one of the panel"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = start.why_no_bake(context.scene.plgs)
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
