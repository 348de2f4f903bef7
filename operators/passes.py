"""Baking panoptic passes of a finished lift, and using them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

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


class OnFinishedLift(OnLiftFolder):
    """An operator that needs an engine, and a lift that is finished."""

    if TYPE_CHECKING:
        poll_message_set: Callable[[str], None]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        panel = panel_of(context)
        reason = start.why_no_engine() or (None if panel is None else start.why_no_bake(panel))
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None


class PLGS_OT_bake_passes(OnFinishedLift, Following, bpy.types.Operator):
    """Render colour, depth, class, instance, confidence and Cryptomatte layers of a finished lift, in the background"""

    bl_idname, bl_label = "plgs.bake_passes", "Bake Passes"

    frames: EnumProperty(  # type: ignore[valid-type]
        name="Frames", items=_FRAMES, default="all", options={"SKIP_SAVE"}, description="Which frames to bake"
    )

    def begin(self, context: bpy.types.Context) -> Watch:
        return start.bake_passes(context.scene, self.frames, self.lift_folder)


class PLGS_OT_bake_camera(OnFinishedLift, Following, bpy.types.Operator):
    """Render the passes of a finished lift as the active camera sees it over the frame range, as it is animated, in the
    background. Frames that are baked already, from the same camera, are kept: so what was cancelled goes on"""

    bl_idname, bl_label = "plgs.bake_camera", "Bake Active Camera, Frame Range"

    camera: StringProperty(  # type: ignore[valid-type]
        name="Camera", options={"SKIP_SAVE"}, description="Empty: the scene's active one"
    )
    frame_start: IntProperty(  # type: ignore[valid-type]
        name="Start", options={"SKIP_SAVE"}, min=0, description="First frame; not given: the scene's"
    )
    frame_end: IntProperty(  # type: ignore[valid-type]
        name="End", options={"SKIP_SAVE"}, min=0, description="Last frame; not given: the scene's"
    )
    frame_step: IntProperty(  # type: ignore[valid-type]
        name="Step", options={"SKIP_SAVE"}, min=1, default=1, description="Not given: the scene's"
    )

    def begin(self, context: bpy.types.Context) -> Watch:
        names = ("frame_start", "frame_end", "frame_step")
        first, last, step = (getattr(self, name) if self.properties.is_property_set(name) else None for name in names)
        return start.bake_camera(context.scene, self.camera, (first, last, step), self.lift_folder)


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


CLASSES = (PLGS_OT_bake_passes, PLGS_OT_bake_camera, PLGS_OT_show_passes)
