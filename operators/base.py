"""Shared by operators: how they report errors, explain grey buttons, and start and cancel tasks."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import bpy
from bpy.props import StringProperty

from ..plgs_blender import registry
from ..plgs_blender.errors import EXPECTED, with_field_names
from ..plgs_blender.registry import Task

FINISHED, CANCELLED = {"FINISHED"}, {"CANCELLED"}
RUNNING, PASSED_ON = {"RUNNING_MODAL"}, {"PASS_THROUGH"}

Execute = Callable[[Any, bpy.types.Context], set[str]]
Handle = Callable[[Any, bpy.types.Context, bpy.types.Event], set[str]]


def panel_of(context: bpy.types.Context) -> Any | None:
    """The settings of the button's panel, for `poll`; None in a script, which passes its own arguments."""
    return getattr(context, "plgs_panel", None)


def reporting(execute: Execute) -> Execute:
    """Decorates an operator's `execute`: an expected error becomes one line for the user and "cancelled".

    Blender checks the number of arguments, so the wrapper takes the same two.
    """

    @wraps(execute)
    def answer(operator: Any, context: bpy.types.Context) -> set[str]:
        try:
            return execute(operator, context)
        except EXPECTED as error:
            operator.report({"ERROR"}, with_field_names(error))
            return CANCELLED

    return answer


def reporting_events(handle: Handle) -> Handle:
    """Does the same for an operator's `invoke` and `modal`."""

    @wraps(handle)
    def answer(operator: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return reporting(lambda self, now: handle(self, now, event))(operator, context)

    return answer


class Explained:
    """An operator whose disabled button explains why."""

    poll_message_set: Callable[[str], None]
    report: Callable[[set[str], str], None]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        """Why it cannot be called now, or None. Never reads the disk."""
        return None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = cls.why_not(context)
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None


class StartsTask(Explained):
    """An operator that starts a task. From a button it returns at once, and the panel shows the progress. From a
    script, with EXEC_DEFAULT or in a Blender without a window, it waits for the end."""

    bl_label: str
    has_undo_step = False
    """Whether a click gets its own undo step, so that a later undo keeps what it set."""

    def begin(self, context: bpy.types.Context) -> Task | None:
        """Start the task; return None if there is nothing to wait for. Raises PlgsError, OSError."""
        raise NotImplementedError

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        """Report the outcome, or that the task is still running, and return Blender's status. Raises PlgsError,
        OSError."""
        if task is None or task.is_running:
            return FINISHED
        if task.error is not None:
            raise task.error
        message = getattr(task, "message", "")
        if message:
            self.report({"INFO"}, message)
        return CANCELLED if task.was_cancelled else FINISHED

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self.run(context, waits=bpy.app.background)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run(context, waits=True)

    def run(self, context: bpy.types.Context, *, waits: bool) -> set[str]:
        """Begin the task, wait for it if asked to, and report the outcome."""
        task = self.begin(context)
        if waits and task is not None:
            registry.wait_for(task, context.scene, self.report_step)
        elif self.has_undo_step:
            bpy.ops.ed.undo_push(message=self.bl_label)
        return self.report_outcome(context, task)

    def report_step(self, line: str) -> None:
        """Called for each new step while a script waits for the task."""


class ChoosesFile(StartsTask):
    """An operator whose button opens the file browser. A script passes the file and waits for the end."""

    was_invoked = False

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.was_invoked = True
        context.window_manager.fileselect_add(self)
        return RUNNING

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run(context, waits=not self.was_invoked)


class CancelsTask(Explained):
    """An operator that cancels the running tasks of one kind. A script waits until they have ended, less than a
    second."""

    cancelled_kind: type[Task]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return None if registry.running(cls.cancelled_kind) else "Nothing is running that can be cancelled"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        for task in registry.running(self.cancelled_kind):
            task.cancel()
            if bpy.app.background:
                registry.wait_for(task, context.scene)
        return FINISHED


def cancels(kind: type[Task], about: str) -> type:
    """Makes the operator that cancels tasks of a kind; ``about`` is its tooltip."""
    names = {"bl_idname": kind.cancel_operator, "bl_label": "Cancel", "bl_options": {"INTERNAL"}}
    name = f"PLGS_OT_{kind.cancel_operator.partition('.')[2]}"
    return type(name, (CancelsTask, bpy.types.Operator), {"__doc__": about, "cancelled_kind": kind, **names})


class OnLiftFolder:
    """An operator on a lift that its folder names."""

    lift_folder: StringProperty(  # type: ignore[valid-type]
        name="Lift Folder", subtype="DIR_PATH", options={"SKIP_SAVE"}, description="Empty: the panel's"
    )
