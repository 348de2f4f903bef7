"""What operators share: how they report errors, explain greyed-out buttons, and start and cancel tasks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, TypeVar, cast

import bpy
from bpy.props import StringProperty

from ..plgs_blender import registry
from ..plgs_blender.errors import EXPECTED, with_field_names
from ..plgs_blender.owned import note_gone
from ..plgs_blender.registry import Task
from ..plgs_blender.settings import option_names

FINISHED, CANCELLED = {"FINISHED"}, {"CANCELLED"}
RUNNING, PASSED_ON = {"RUNNING_MODAL"}, {"PASS_THROUGH"}

Method = TypeVar("Method", bound=Callable[..., set[str]])


def argument(kind: Callable[..., Any], name: str, about: str = "", **more: Any) -> Any:
    """Declare an operator's property that Blender forgets after each call, as "not given" has a meaning of its own."""
    return kind(name=name, description=about, options={"SKIP_SAVE"}, **more)


text_argument = partial(argument, StringProperty)
folder_argument = partial(argument, StringProperty, subtype="DIR_PATH")
file_argument = partial(argument, StringProperty, subtype="FILE_PATH")


def panel_of(context: bpy.types.Context) -> Any | None:
    """Return the settings of the button's panel, for `poll`; None in a script, which passes arguments."""
    return getattr(context, "plgs_panel", None)


def why_no_folder(context: bpy.types.Context) -> str | None:
    """Return what is missing as long as the panel has no scene, else None."""
    return None if context.scene.plgs.scene_folder else "Choose the scene's folder first"


def reporting(method: Method) -> Method:
    """Decorate `execute`, `invoke` or `modal`: an expected error is reported in one line, and CANCELLED returned."""

    def answer(operator: Any, *given: Any) -> set[str]:
        try:
            return method(operator, *given)
        except EXPECTED as error:
            note_gone(error)
            operator.report({"ERROR"}, with_field_names(error))
            return CANCELLED

    # Blender counts a method's arguments, so each wrapper takes as many as the method.
    @wraps(method)
    def execute(operator: Any, context: bpy.types.Context) -> set[str]:
        return answer(operator, context)

    @wraps(method)
    def on_event(operator: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return answer(operator, context, event)

    return cast(Method, execute if method.__code__.co_argcount == 2 else on_event)


class Explained:
    """An operator whose button, when it is disabled, explains why."""

    poll_message_set: Callable[[str], None]
    report: Callable[[set[str], str], None]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        """Return why the operator cannot be called now, or None if it can be. Never reads the disk."""
        return None

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = cls.why_not(context)
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None


class Acts(Explained):
    """An operator that does its work in one call, without a task."""

    def act(self, context: bpy.types.Context) -> str | None:
        """Do the operator's work. Returns a line to report, or None. Raises PlgsError or OSError, which is reported."""
        raise NotImplementedError

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        line = self.act(context)
        if line:
            self.report({"INFO"}, line)
        return FINISHED


class StartsTask(Explained):
    """An operator that starts a task. From a button it returns at once, and the panel shows the progress. From a
    script, with EXEC_DEFAULT or in a Blender without a window, it waits for the end."""

    bl_label: str
    has_undo_step = False
    """Whether a click gets its own undo step, so that a later undo keeps what it set."""

    def begin(self, context: bpy.types.Context) -> Task | None:
        """Start the task; return None if there is nothing to wait for. Raises PlgsError or OSError if that fails."""
        raise NotImplementedError

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        """Report the outcome, if there is one yet, and return Blender's status. Raises the task's error."""
        if task is None or task.is_running:
            return FINISHED
        if task.error is not None:
            raise task.error
        message = getattr(task, "message", "")
        if message:
            self.report({"INFO"}, message)
        return CANCELLED if task.was_cancelled else FINISHED

    @reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self.run(context, waits=bpy.app.background)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run(context, waits=True)

    def run(self, context: bpy.types.Context, *, waits: bool) -> set[str]:
        """Begin the task, wait for its end if it ``waits``, and report the outcome."""
        task = self.begin(context)
        if waits and task is not None:
            registry.wait_for(task, context.scene, self.report_step)
        elif self.has_undo_step:
            bpy.ops.ed.undo_push(message=self.bl_label)
        return self.report_outcome(context, task)

    def report_step(self, line: str) -> None:
        """Report each new step while a script waits for the task."""


class AsksFirst(StartsTask):
    """An operator whose button asks the user for its options. A script passes them, and waits for the end."""

    was_invoked = False

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.was_invoked = True
        return self.ask(context.window_manager, event)

    def ask(self, manager: bpy.types.WindowManager, event: bpy.types.Event) -> set[str]:
        raise NotImplementedError

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run(context, waits=not self.was_invoked)


class ChoosesFile(AsksFirst):
    """An operator whose button opens the file browser."""

    def ask(self, manager: bpy.types.WindowManager, event: bpy.types.Event) -> set[str]:
        manager.fileselect_add(self)
        return RUNNING


class CancelsTask(Explained):
    """An operator that cancels the running tasks of one kind. A script waits until they end, within a second."""

    cancelled_kind: type[Task]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return None if registry.running(cls.cancelled_kind) else "There is nothing to cancel"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        for task in registry.running(self.cancelled_kind):
            task.cancel()
            if bpy.app.background:
                registry.wait_for(task, context.scene)
        return FINISHED


def cancels(kind: type[Task], about: str) -> type:
    """Make the operator that cancels tasks of a kind; ``about`` is its tooltip."""
    names = {"bl_idname": kind.cancel_operator, "bl_label": "Cancel", "bl_options": {"INTERNAL"}}
    name = f"PLGS_OT_{kind.cancel_operator.partition('.')[2]}"
    return type(name, (CancelsTask, bpy.types.Operator), {"__doc__": about, "cancelled_kind": kind, **names})


def copy_given(operator: Any, options: type, settings: Any) -> None:
    """Copy to the panel those of the ``options`` (a class with properties) that a call gave explicitly."""
    for name in option_names(options):
        if operator.properties.is_property_set(name):
            setattr(settings, name, getattr(operator, name))


def start_timer(operator: Any, context: bpy.types.Context, seconds: float) -> bpy.types.Timer:
    """Add a timer, so that an operator's `modal` is called at least every so many seconds."""
    manager = context.window_manager
    manager.modal_handler_add(operator)
    return manager.event_timer_add(seconds, window=context.window or manager.windows[0])  # None in a timer


class OnLiftFolder:
    """An operator on the lift in the folder `lift_folder`."""

    lift_folder: folder_argument("Lift Folder", "Folder of the lift; empty: the panel's")
