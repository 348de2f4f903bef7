"""Starting, watching, stopping and resuming a lift.

In a window they return at once and end with the lift; called by a script with EXEC_DEFAULT, as in Blender without a
window, they wait for it. The state machine behind both is `plgs_blender.running.lifts`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..plgs_blender.lift_scene import place_passes_anew
from ..plgs_blender.running import lifts, poll_timer, recents, start
from ..plgs_blender.running.lifts import Watch
from ..plgs_blender.settings import LiftOptions, chosen_lift
from ..plgs_blender.viewport import show_lift_colours_at_first
from .answers import CANCELLED, FINISHED, PASSED_ON, RUNNING, panel_of, reporting, reporting_events

_GLANCE_S = 0.25
"""How often a waiting operator looks whether its lift has ended."""


_waited_for: set[Path] = set()
"""The lifts whose end some operator waits for: one is enough."""


class OnLiftFolder:
    """An operator on a lift that is named by its folder."""

    lift_folder: StringProperty(  # type: ignore[valid-type]
        name="Lift folder", subtype="DIR_PATH", options={"SKIP_SAVE"}, description="Empty: the one of the panel"
    )


class Following:
    """An operator that begins or joins a lift and ends with it."""

    begin: Callable[[bpy.types.Context], Watch]
    """Each such operator's own: start or join; raises what `reporting` reports."""
    bl_label: str
    report: Callable[[set[str], str], None]
    _folder: Path | None = None
    _timer: bpy.types.Timer | None = None

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self.follow(context)

    def follow(self, context: bpy.types.Context) -> set[str]:
        """Begin, and wait for the end without keeping Blender."""
        folder = self.begin(context).folder.path
        poll_timer.begin()
        if folder in _waited_for:  # by another operator, which will tell how it ends
            return FINISHED
        self._folder = folder
        _waited_for.add(folder)
        # Now, not when the lift ends: undoing what the user does meanwhile shall not take the lift out of the panel.
        bpy.ops.ed.undo_push(message=self.bl_label)
        self.glance(context)
        return RUNNING

    def glance(self, context: bpy.types.Context, every_s: float = _GLANCE_S) -> None:
        """Be called now and then from here on."""
        if self._timer is None:
            manager = context.window_manager
            self._timer = manager.event_timer_add(every_s, window=context.window or manager.windows[0])
            manager.modal_handler_add(self)

    @reporting_events
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        followed = None if self._folder is None else lifts.watch_of(self._folder)
        if event.type != "TIMER" or (followed is not None and followed.is_running):
            poll_timer.begin()  # in case an error of ours has stopped the timer
            return PASSED_ON
        self.cancel(context)
        return CANCELLED if followed is None else self._end(context, followed)

    def cancel(self, context: bpy.types.Context) -> None:
        """Another file was opened, or it is over. The lift itself goes on, followed by the module."""
        if self._folder is not None:
            _waited_for.discard(self._folder)
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        followed = self.begin(context)
        lifts.wait_for(followed)
        return self._end(context, followed)

    def _end(self, context: bpy.types.Context, followed: Watch) -> set[str]:
        """Tell how it ended; show a finished lift if this scene is still set to it and wants to."""
        outcome = followed.outcome
        assert outcome is not None
        self.report({"ERROR" if outcome.error else "INFO"}, lifts.message_for(followed))
        if not followed.ended_well:
            return CANCELLED
        if followed.is_baking:
            place_passes_anew(followed.folder.path, context.scene)
        elif context.scene.plgs.place_when_done and chosen_lift(context.scene.plgs) == followed.folder.path:
            show_result(context, str(followed.folder.path))
        else:
            return FINISHED
        if not bpy.app.background:
            bpy.ops.ed.undo_push(message="Show Result")
        return FINISHED


def show_result(context: bpy.types.Context, lift_folder: str) -> bpy.types.Collection:
    """Place a finished lift, in its colours where the view is as Blender starts it. Raises JobError, SceneError."""
    root = start.show_lift(context.scene, lift_folder)
    if context.space_data is not None and context.space_data.type == "VIEW_3D":
        show_lift_colours_at_first(context.space_data)
    return root


class PLGS_OT_lift_scene(LiftOptions, Following, bpy.types.Operator):
    """Lift the scene: an engine starts in the background. What is not given is as in the panel"""

    bl_idname, bl_label = "plgs.lift_scene", "Start"

    names_from: StringProperty(  # type: ignore[valid-type]
        name="Names from", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="An earlier lift whose objects keep their names; empty: the one in this scene, if names are kept",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        panel = panel_of(context)
        reason = start.why_no_engine() or (None if panel is None else start.why_no_lift(panel))
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    def begin(self, context: bpy.types.Context) -> Watch:
        settings = context.scene.plgs
        for name in LiftOptions.__annotations__:
            if self.properties.is_property_set(name):
                setattr(settings, name, getattr(self, name))
        in_that_folder = self.properties.is_property_set("lift_folder")
        return start.start_lift(settings, in_that_folder=in_that_folder, names_from=self.names_from)


class PLGS_OT_resume_lift(OnLiftFolder, Following, bpy.types.Operator):
    """Go on with a lift that was cancelled or broke off"""

    bl_idname, bl_label = "plgs.resume_lift", "Resume"

    def begin(self, context: bpy.types.Context) -> Watch:
        return start.resume_lift(context.scene.plgs, self.lift_folder)


class PLGS_OT_watch_lift(OnLiftFolder, Following, bpy.types.Operator):
    """Follow a lift that another Blender or a command started, or look at one that has ended"""

    bl_idname, bl_label = "plgs.watch_lift", "Watch"

    def begin(self, context: bpy.types.Context) -> Watch:
        return start.join_lift(context.scene.plgs, self.lift_folder)


class PLGS_OT_cancel_lift(OnLiftFolder, bpy.types.Operator):
    """Stop the lift at its next step, within a second; it can be resumed"""

    bl_idname, bl_label = "plgs.cancel_lift", "Cancel"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        start.cancel_lift(context.scene.plgs, self.lift_folder)
        return FINISHED


class PLGS_OT_refresh_lifts(bpy.types.Operator):
    """Look anew which lifts are running or have ended, of this Blender and others"""

    bl_idname, bl_label, bl_options = "plgs.refresh_lifts", "Look Again", {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        recents.refresh()
        return FINISHED


class PLGS_OT_place_lift(OnLiftFolder, bpy.types.Operator):
    """Put a finished lift into the scene: cameras, points, anchors, boxes and passes"""

    bl_idname, bl_label, bl_options = "plgs.place_lift", "Show Result", {"UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = show_result(context, self.lift_folder)
        self.report({"INFO"}, f"{root.name} is placed")
        return FINISHED


class PLGS_OT_open_log(OnLiftFolder, bpy.types.Operator):
    """Show the engine's log in a text editor of the system"""

    bl_idname, bl_label, bl_options = "plgs.open_log", "Open Log", {"INTERNAL"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        bpy.ops.wm.path_open(filepath=str(start.log_of(context.scene.plgs, self.lift_folder)))
        return FINISHED


CLASSES = (
    PLGS_OT_lift_scene,
    PLGS_OT_resume_lift,
    PLGS_OT_watch_lift,
    PLGS_OT_cancel_lift,
    PLGS_OT_refresh_lifts,
    PLGS_OT_place_lift,
    PLGS_OT_open_log,
)
