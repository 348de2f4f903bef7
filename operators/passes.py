"""Operators that bake panoptic passes of a finished lift, and use them in the compositor."""

from __future__ import annotations

import math

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from ..plgs_blender import compositing
from ..plgs_blender.compositing import show_compositor, show_room
from ..plgs_blender.engine_environment import usable_python, why_no_engine
from ..plgs_blender.errors import PlgsError, one_line
from ..plgs_blender.owned import KEY, scene_to_fill
from ..plgs_blender.passes import open_passes, passes_scene_of
from ..plgs_blender.registry import Task
from ..plgs_blender.running import lifting
from ..plgs_blender.shot_names import next_versions_name
from ..plgs_blender.shots import ShotReader, shot_of
from . import base
from .inspect import OnClass, OnInstance, OnLift

_FRAMES = [
    ("all", "All Frames", "Bake every frame that has no passes yet"),
    ("test", "Check Frames", "Bake the held-out frames, which the lift did not learn from"),
    ("active", "Active Camera", "Bake the frame whose camera is the scene's active one"),
]
_FOR_CHANGED = [
    ("VERSION", "Next Version", "Keep the earlier files, and number this version"),
    ("REPLACE", "Replace", "Replace the earlier files"),
]
_READ_S, _READ_EVERY_S = 0.04, 0.06
"""Seconds for which a camera is read before Blender may redraw, and seconds between two such parts."""


class BakesFinishedLift(base.OnLiftFolder, base.StartsTask):
    """An operator that needs an engine and a finished lift; it bakes the layers chosen in the panel."""

    has_undo_step = True

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        panel = base.panel_of(context)
        return why_no_engine() or (None if panel is None else lifting.why_no_bake(panel))


class PLGS_OT_bake_passes(BakesFinishedLift, bpy.types.Operator):
    """Render colour, depth, class, instance, confidence and Cryptomatte layers of a finished lift, in the background"""

    bl_idname, bl_label = "plgs.bake_passes", "Bake Passes"

    frames: base.argument(EnumProperty, "Frames", "Which frames to bake", items=_FRAMES, default="all")

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.bake_passes(context.scene, self.frames, self.lift_folder)


class PLGS_OT_bake_camera(BakesFinishedLift, bpy.types.Operator):
    """Render the passes of a finished lift through the animated active camera over the frame range, in the background.
    Frames already baked from the same camera are kept, so a cancelled bake continues"""

    bl_idname, bl_label = "plgs.bake_camera", "Bake Active Camera, Frame Range"

    camera: base.text_argument("Camera", "Empty: the scene's active one")
    frame_start: base.argument(IntProperty, "Start", "First frame; not given: the scene's")
    frame_end: base.argument(IntProperty, "End", "Last frame; not given: the scene's")
    frame_step: base.argument(IntProperty, "Step", "Every n-th frame; not given: the scene's", min=1, default=1)

    shot: base.text_argument("Shot", "The name of its files; empty: the .blend's and the camera's")
    replace: base.argument(
        BoolProperty, "Replace", "Replace a shot of this name from another file or camera, or with a changed camera"
    )

    _shot: ShotReader | None = None
    _timer: bpy.types.Timer | None = None

    def begin(self, context: bpy.types.Context) -> Task:
        shot = self._shot or self._begin_reading(context)
        shot.read_for(math.inf)  # all at once for a script
        bake = lifting.bake_shot(context.scene, shot, self.lift_folder, replace=self.replace)
        for what in shot.said:
            self.report({"WARNING"}, what)
        return bake

    def run(self, context: bpy.types.Context, *, waits: bool) -> set[str]:
        """Run like every task. If the shot was baked before and shows something else, a button asks what to do."""
        try:
            return super().run(context, waits=waits)
        except PlgsError as error:
            if waits or error.key != "shot-changed":
                raise
            asked = {"shot": self.shot, "lift_folder": self.lift_folder, "what": error.what}
            return set(bpy.ops.plgs.bake_changed_shot("INVOKE_DEFAULT", **asked))

    def _begin_reading(self, context: bpy.types.Context) -> ShotReader:
        # Now, because another scene may be shown by the time the camera is read.
        self.lift_folder = str(lifting.lift_at(context.scene.plgs, self.lift_folder).path)
        names = ("frame_start", "frame_end", "frame_step")
        first, last, step = (getattr(self, name) if self.properties.is_property_set(name) else None for name in names)
        motion = "vector" in context.scene.plgs.layers
        shot = shot_of(context.scene, self.camera, first=first, last=last, step=step, given=self.shot, motion=motion)
        for what in shot.warnings:
            self.report({"WARNING"}, what)
        usable_python()  # raises an error now if there is no engine to bake it
        return ShotReader(context.scene, shot)

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._shot = self._begin_reading(context)
        if self._shot.read_for(_READ_S):
            return self.run(context, waits=bpy.app.background)
        self._timer = base.start_timer(self, context, _READ_EVERY_S)
        return base.RUNNING

    @base.reporting
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        answer = base.CANCELLED
        try:
            assert self._shot is not None
            answer = self._read_on(context, event, self._shot)
        finally:
            if answer not in (base.RUNNING, base.PASSED_ON):
                self.cancel(context)
        return answer

    def _read_on(self, context: bpy.types.Context, event: bpy.types.Event, shot: ShotReader) -> set[str]:
        """Read a part of the camera's path. After the last part, start baking."""
        if event.type == "ESC" and event.value == "PRESS":
            self.report({"INFO"}, "Reading the camera was cancelled; nothing was baked")
            return base.CANCELLED
        if event.type != "TIMER":
            return base.PASSED_ON
        if shot.read_for(_READ_S):
            _show_progress(context, None)
            return self.run(context, waits=False)
        _show_progress(context, "Reading the camera: {} of {} frames. Esc stops".format(*shot.progress))
        return base.RUNNING

    def cancel(self, context: bpy.types.Context) -> None:
        """Remove the timer and the progress text, when the camera was read or another file is opened."""
        _show_progress(context, None)
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None


class PLGS_OT_bake_changed_shot(base.OnLiftFolder, bpy.types.Operator):
    """Bake the active camera's shot, of which the lift, its corrections or the camera have changed since: as the next
    version, or in place of the earlier one"""

    bl_idname, bl_label = "plgs.bake_changed_shot", "The Shot Shows Another State"

    how: base.argument(EnumProperty, "How", "What to do with the earlier one", items=_FOR_CHANGED, default="VERSION")
    shot: base.text_argument("Shot", "The name of its files; empty: the .blend's and the camera's")
    what: base.text_argument("What", "What has changed")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return set(context.window_manager.invoke_props_dialog(self, width=600))

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.label(text=one_line(self.what))
        self.layout.prop(self, "how", expand=True)

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        replaces = self.how == "REPLACE"
        if not replaces:
            context.scene.plgs.shot = self.shot = next_versions_name(self.shot)
        how = {"shot": self.shot, "replace": replaces, "lift_folder": self.lift_folder}
        return set(bpy.ops.plgs.bake_camera("INVOKE_DEFAULT", **how))


class PLGS_OT_bake_on_farm(base.OnLiftFolder, base.Acts, bpy.types.Operator):
    """Write a Flamenco job that bakes the active camera over the frame range on a render farm. The farm must be able to
    read the lift and this file"""

    bl_idname, bl_label = "plgs.bake_on_farm", "Bake on Farm"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        panel = base.panel_of(context)
        return None if panel is None else lifting.why_no_bake(panel)

    def act(self, context: bpy.types.Context) -> str:
        job = lifting.bake_on_farm(context.scene, self.lift_folder)
        return f"Wrote the job, which bakes this file as it was last saved: {job}"


def _show_progress(context: bpy.types.Context, text: str | None) -> None:
    """Show a text in the status bar; None restores Blender's own."""
    if context.workspace is not None:
        context.workspace.status_text_set(text)


def _why_no_passes(context: bpy.types.Context) -> str | None:
    has_passes = passes_scene_of(context.scene) is not None
    return None if has_passes else "This scene has no lift with passes: bake them first"


class PLGS_OT_show_passes(base.Acts, bpy.types.Operator):
    """Open the Compositing workspace with the passes of the active camera, if any, else those of the lift's frames"""

    bl_idname, bl_label, bl_options = "plgs.show_passes", "Open in Compositor", {"UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return _why_no_passes(context)

    def act(self, context: bpy.types.Context) -> None:
        target = open_passes(context.scene)
        if context.window is not None:
            show_compositor(context.window, target)


class PLGS_OT_show_room(base.Acts, bpy.types.Operator):
    """Show the lift's own scene again, in the workspace from which the compositor was opened"""

    bl_idname, bl_label, bl_options = "plgs.show_room", "Back to the Room", {"UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return None if KEY in context.scene else "This is not a scene of passes"

    def act(self, context: bpy.types.Context) -> None:
        if context.window is None:
            what = "there is no window to show the scene in"
            raise PlgsError("no-window", what, context.scene.name, "Open this file in a window.")
        show_room(context.window)


class _Matte(OnLift):
    """An operator that chooses the matte, also in the scene of the passes."""

    room = staticmethod(scene_to_fill)

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return super().why_not(context) or (base.panel_of(context) and _why_no_passes(context))


class PLGS_OT_matte_instance(_Matte, OnInstance, bpy.types.Operator):
    """Use this instance as the matte in the compositor"""

    bl_idname, bl_label, bl_options = "plgs.matte_instance", "Matte", {"REGISTER", "UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        return one_line(f"The compositor's matte is {compositing.matte_instance(root, self.instance)}")


class PLGS_OT_matte_class(_Matte, OnClass, bpy.types.Operator):
    """Use everything of this class as the matte in the compositor"""

    bl_idname, bl_label, bl_options = "plgs.matte_class", "Matte", {"REGISTER", "UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        return one_line(f"The compositor's matte is {compositing.matte_class(root, self.class_id)}")
