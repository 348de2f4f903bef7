"""Operators that set up the engine, choose its Python, check it, and remove it."""

from __future__ import annotations

from functools import partial

import bpy
from bpy.props import EnumProperty

from ..plgs_blender import registry
from ..plgs_blender.chosen_scene import absolute
from ..plgs_blender.engine_environment import choices, status, tasks, usable_python, why_no_engine
from ..plgs_blender.registry import Task
from ..plgs_blender.running import adding
from . import base

_TORCH_BUILDS = [
    ("preferences", "As in the Preferences", "The build chosen in the add-on's preferences"),
    *choices.TORCH_BUILDS,
]


_index_argument = partial(
    base.text_argument, "Package Index", "The package index to download from; empty: as in the preferences"
)


class AsksEngine(base.StartsTask):
    """An operator whose task ends with the engine's answer, which is reported."""

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        if task is not None and task.is_running:
            return base.FINISHED
        engine = status()
        self.report({"INFO" if engine.is_usable else "ERROR"}, f"{engine.message}. {engine.fix}".rstrip())
        return base.FINISHED if engine.is_usable else base.CANCELLED


class PLGS_OT_set_up_engine(AsksEngine, bpy.types.Operator):
    """Download what the engine needs, about 1.8 GB, into its own environment. An interrupted set-up continues"""

    bl_idname, bl_label = "plgs.set_up_engine", "Set Up Engine"

    base_python: base.file_argument("Base Python", "The environment's Python; empty: as in the preferences")
    torch_build: base.argument(EnumProperty, "Torch", items=_TORCH_BUILDS, default="preferences")
    index_url: _index_argument()

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return tasks.why_no_set_up()

    def begin(self, context: bpy.types.Context) -> Task:
        build = "" if self.torch_build == "preferences" else self.torch_build
        return tasks.set_up(choices.set_up_choice(self.base_python, build, self.index_url))

    def report_step(self, line: str) -> None:
        print(f"Set Up Engine {line}", flush=True)

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        if task is None or task.is_running:
            return base.FINISHED
        if task.error is not None:
            raise task.error
        for check in registry.running(tasks.EngineCheck):
            registry.wait_for(check, context.scene)
        return super().report_outcome(context, task)


class PLGS_OT_add_to_engine(base.StartsTask, bpy.types.Operator):
    """Download optional packages and add them to the engine. Cancelling leaves the engine as it was"""

    bl_idname, bl_label = "plgs.add_to_engine", "Add to Engine"

    capability: base.argument(EnumProperty, "Purpose", "What the packages are for", items=adding.ITEMS)
    index_url: _index_argument()

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return why_no_engine() or adding.why_not_added()

    def begin(self, context: bpy.types.Context) -> Task:
        return adding.add(self.capability, usable_python(), self.index_url)


class PLGS_OT_use_this_python(AsksEngine, bpy.types.Operator):
    """Run the engine with this Python. It needs torch and the engine's other pinned packages"""

    bl_idname, bl_label = "plgs.use_this_python", "Use This Python"

    python: base.file_argument("Python", "The Python's executable; empty: Blender's own")

    def begin(self, context: bpy.types.Context) -> Task | None:
        choices.choose(absolute(self.python) if self.python else choices.own_python())
        return tasks.ask_chosen()


class PLGS_OT_check_engine(AsksEngine, bpy.types.Operator):
    """Check the engine's version, and what it lacks"""

    bl_idname, bl_label = "plgs.check_engine", "Check"

    def begin(self, context: bpy.types.Context) -> Task | None:
        return tasks.check()


class PLGS_OT_open_set_up_log(bpy.types.Operator):
    """Open the log of the last set-up, with all of uv's output"""

    bl_idname, bl_label = "plgs.open_set_up_log", "Open Log"

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        log = tasks.log_path()
        if not log.is_file():
            self.report({"ERROR"}, f"There is no log at {log}: the engine has not been set up here yet")
            return base.CANCELLED
        self.report({"INFO"}, str(log))
        return base.FINISHED if bpy.app.background else bpy.ops.wm.path_open(filepath=str(log))


class PLGS_OT_remove_engine(base.AsksFirst, bpy.types.Operator):
    """Delete the environments that "Set Up Engine" made, and nothing else. A lift running in one would end"""

    bl_idname, bl_label = "plgs.remove_engine", "Remove Engine"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return None if tasks.running_set_up() is None else "The engine is being set up"

    def ask(self, manager: bpy.types.WindowManager, event: bpy.types.Event) -> set[str]:
        return set(manager.invoke_confirm(self, event))

    def begin(self, context: bpy.types.Context) -> Task:
        return tasks.remove()


class PLGS_OT_show_preferences(base.Acts, bpy.types.Operator):
    """Show the add-on's preferences, where the engine is set up"""

    bl_idname, bl_label = "plgs.show_preferences", "Preferences"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        missing = "PLGS is running without being installed as an extension, so it has no preferences"
        return missing if choices.preferences() is None else None

    def act(self, context: bpy.types.Context) -> None:
        bpy.ops.preferences.addon_show(module=choices.EXTENSION)


PLGS_OT_cancel_engine_set_up = base.cancels(tasks.SetUp, "Stop setting up the engine. The next set-up continues")
PLGS_OT_cancel_adding = base.cancels(adding.Adding, "Stop adding packages; the engine stays as it was")
