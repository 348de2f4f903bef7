"""Baking panoptic passes of a finished lift, and using them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ..plgs_blender import passes_view
from ..plgs_blender.running import start
from ..plgs_blender.running.lifts import Watch
from ..plgs_blender.shots import ShotReader
from .answers import CANCELLED, FINISHED, PASSED_ON, RUNNING, panel_of, reporting, reporting_events
from .lift import Following, OnLiftFolder

_FRAMES = [
    ("all", "All frames", "Bake every frame that has no passes yet"),
    ("test", "Held-out frames", "Bake the frames that were held out of training"),
    ("active", "Active camera", "Bake the frame whose camera is the scene's active one"),
]
_READ_S, _READ_EVERY_S = 0.04, 0.06
"""So long at a time a camera is read while Blender waits, and how often."""


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

    _shot: ShotReader | None = None

    def begin(self, context: bpy.types.Context) -> Watch:
        shot = self._shot or self._begin_reading(context)
        shot.read_for(math.inf)  # all at once for a script
        self._shot = None
        return start.bake_shot(context.scene, shot, self.lift_folder)

    def _begin_reading(self, context: bpy.types.Context) -> ShotReader:
        # Now: by the time that it is read another scene may be shown.
        self.lift_folder = str(start.lift_at(context.scene.plgs, self.lift_folder).path)
        names = ("frame_start", "frame_end", "frame_step")
        first, last, step = (getattr(self, name) if self.properties.is_property_set(name) else None for name in names)
        return start.read_camera(context.scene, self.camera, (first, last, step))

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._shot = self._begin_reading(context)
        if self._shot.read_for(_READ_S):
            return self.follow(context)
        self.glance(context, _READ_EVERY_S)
        return RUNNING

    @reporting_events
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self._shot is None:  # it is read, and an engine bakes
            answer: set[str] = super().modal(context, event)
            return answer
        answer = CANCELLED
        try:
            answer = self._read_on(context, event, self._shot)
        finally:
            if answer not in (RUNNING, PASSED_ON):
                self.cancel(context)
        return answer

    def _read_on(self, context: bpy.types.Context, event: bpy.types.Event, shot: ShotReader) -> set[str]:
        if event.type == "ESC" and event.value == "PRESS":
            self.report({"INFO"}, "The camera is not read any further, and nothing is baked")
            return CANCELLED
        if event.type != "TIMER":
            return PASSED_ON
        if shot.read_for(_READ_S):
            _show_progress(context, None)
            return self.follow(context)
        _show_progress(context, "Reading the camera: {} of {} frames. Esc stops".format(*shot.progress))
        return RUNNING

    def cancel(self, context: bpy.types.Context) -> None:
        _show_progress(context, None)
        super().cancel(context)


def _show_progress(context: bpy.types.Context, text: str | None) -> None:
    """In the status bar; None: what Blender shows there."""
    if context.workspace is not None:
        context.workspace.status_text_set(text)


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
