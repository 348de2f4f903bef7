"""What operators share: how they report errors, why their buttons are grey, and how they start and cancel tasks."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import bpy
from bpy.props import StringProperty

from ..plgs_blender.errors import EXPECTED, with_field_names
from ..plgs_blender.tasks import registry
from ..plgs_blender.tasks.registry import Task

FINISHED, CANCELLED = {"FINISHED"}, {"CANCELLED"}
RUNNING, PASSED_ON = {"RUNNING_MODAL"}, {"PASS_THROUGH"}

Execute = Callable[[Any, bpy.types.Context], set[str]]
Handle = Callable[[Any, bpy.types.Context, bpy.types.Event], set[str]]


def panel_of(context: bpy.types.Context) -> Any | None:
    """The settings of the panel that a button stands in, for `poll`; None for a script, whose arguments count."""
    return getattr(context, "plgs_panel", None)


def reporting(execute: Execute) -> Execute:
    """Decorates an operator's `execute`: an expected error becomes one line for the user and "cancelled".

    Blender counts the arguments, hence the two of them.
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
    """Decorates an operator's `invoke` and `modal` in the same way."""

    @wraps(handle)
    def answer(operator: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return reporting(lambda self, now: handle(self, now, event))(operator, context)

    return answer


class Explained:
    """An operator whose grey button says why."""

    poll_message_set: Callable[[str], None]
    report: Callable[[set[str], str], None]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        """Why it cannot be called now; None when it can. Looks at no disk."""
        return None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = cls.why_not(context)
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None


class StartsTask(Explained):
    """An operator that starts a task. From a button it returns at once, and the panel shows how far the task is. A
    script, which calls it with EXEC_DEFAULT or in a Blender without a window, waits for the end.
    """

    bl_label: str
    has_undo_step = False
    """Whether a button's click is worth an undo step of its own: later undo then keeps what it set."""

    def begin(self, context: bpy.types.Context) -> Task | None:
        """Start the task; None when nothing is left to wait for. Raises PlgsError, OSError."""
        raise NotImplementedError

    def tell(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        """Report what became of it, or that it goes on, and answer Blender. Raises PlgsError, OSError."""
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
        """Begin, wait if asked to, and tell."""
        task = self.begin(context)
        if waits and task is not None:
            registry.wait_for(task, context.scene, self.tell_step)
        elif self.has_undo_step:
            bpy.ops.ed.undo_push(message=self.bl_label)
        return self.tell(context, task)

    def tell_step(self, line: str) -> None:
        """Called for each new step of a task that is waited for."""


class CancelsTask(Explained):
    """An operator that cancels the running tasks of a kind. A script waits until they have ended, within a second."""

    cancelled_kind: type[Task]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return None if registry.running(cls.cancelled_kind) else "Nothing is running that could be cancelled"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        for task in registry.running(self.cancelled_kind):
            task.cancel()
            if bpy.app.background:
                registry.wait_for(task, context.scene)
        return FINISHED


class OnLiftFolder:
    """An operator on a lift that is named by its folder."""

    lift_folder: StringProperty(  # type: ignore[valid-type]
        name="Lift folder", subtype="DIR_PATH", options={"SKIP_SAVE"}, description="Empty: the one of the panel"
    )
