"""Getting the engine: setting it up, choosing its Python, asking it, removing it.

In a window the buttons return at once, and `plgs_blender.engine_environment.session` follows what goes on; called by a
script with EXEC_DEFAULT, as in Blender without a window, they wait for it.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender.engine_environment import choices, session
from ..plgs_blender.paths import absolute
from .answers import CANCELLED, FINISHED, reporting, reporting_events

register, unregister = session.register, session.unregister

_TORCH_BUILDS = [
    ("preferences", "As in the preferences", "What the add-on's preferences say"),
    *choices.TORCH_BUILDS,
]


class Asking:
    """An operator that begins something which ends with the engine's answer."""

    begin: Callable[[], None]
    """Each such operator's own; raises what `reporting` reports."""
    report: Callable[[set[str], str], None]
    sets_up = False

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.begin()
        return FINISHED

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self.begin()
        session.wait(lambda line: print(f"Set up engine {line}", flush=True))
        if self.sets_up and (error := session.set_up_error()) is not None:
            raise error
        engine = session.status()
        self.report({"INFO" if engine.is_usable else "ERROR"}, f"{engine.message}. {engine.fix}".rstrip())
        return FINISHED if engine.is_usable else CANCELLED


class PLGS_OT_set_up_engine(Asking, bpy.types.Operator):
    """Download what the engine needs into an environment of its own, about 1.3 GB. What was begun is gone on with"""

    bl_idname, bl_label = "plgs.set_up_engine", "Set up engine"
    sets_up = True

    base_python: StringProperty(  # type: ignore[valid-type]
        name="Base Python",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
        description="The Python to make the environment from; empty: as in the preferences",
    )
    torch_build: EnumProperty(  # type: ignore[valid-type]
        name="Torch", items=_TORCH_BUILDS, default="preferences", options={"SKIP_SAVE"}
    )
    index_url: StringProperty(  # type: ignore[valid-type]
        name="Package index",
        options={"SKIP_SAVE"},
        description="The package index to download from; empty: as in the preferences",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = session.why_no_set_up()
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    def begin(self) -> None:
        build = "" if self.torch_build == "preferences" else self.torch_build
        session.start_set_up(choices.wish(self.base_python, build, self.index_url))


class PLGS_OT_cancel_engine_set_up(bpy.types.Operator):
    """Stop setting the engine up. What was downloaded is kept, and the next time goes on with it"""

    bl_idname, bl_label = "plgs.cancel_engine_set_up", "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if session.progress() is None:
            cls.poll_message_set("The engine is not being set up")
        return session.progress() is not None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        session.cancel_set_up()
        return FINISHED


class PLGS_OT_use_this_python(Asking, bpy.types.Operator):
    """Let this Python run the engine. It needs torch and the other packages that the engine is pinned to"""

    bl_idname, bl_label = "plgs.use_this_python", "Use this Python"

    python: StringProperty(  # type: ignore[valid-type]
        name="Python",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
        description="The Python's executable; empty: Blender's own",
    )

    def begin(self) -> None:
        choices.choose(absolute(self.python) if self.python else choices.own_python())
        session.check()


class PLGS_OT_check_engine(Asking, bpy.types.Operator):
    """Ask the engine what it is and what it lacks"""

    bl_idname, bl_label = "plgs.check_engine", "Check"

    def begin(self) -> None:
        session.check()


class PLGS_OT_open_set_up_log(bpy.types.Operator):
    """Open the log of the last set-up, with all that pip said"""

    bl_idname, bl_label = "plgs.open_set_up_log", "Open log"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        log = session.log_path()
        if not log.is_file():
            self.report({"ERROR"}, f"There is no log: {log}. The engine was not set up here yet.")
            return CANCELLED
        self.report({"INFO"}, str(log))
        return FINISHED if bpy.app.background else bpy.ops.wm.path_open(filepath=str(log))


class PLGS_OT_remove_engine(bpy.types.Operator):
    """Delete the environments that "Set up engine" made, and nothing else. A lift that runs in one would end"""

    bl_idname, bl_label = "plgs.remove_engine", "Remove engine"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if session.progress() is not None:
            cls.poll_message_set("The engine is being set up")
        return session.progress() is None

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        session.remove()
        if bpy.app.background:
            session.wait()
        return FINISHED


class PLGS_OT_show_preferences(bpy.types.Operator):
    """Show the add-on's preferences, where the engine is set up"""

    bl_idname, bl_label = "plgs.show_preferences", "Preferences"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not choices.are_in_preferences():
            cls.poll_message_set("PLGS runs without being installed as an extension: it has no preferences")
        return choices.are_in_preferences()

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        answer: set[str] = bpy.ops.preferences.addon_show(module=choices.EXTENSION)
        return answer


CLASSES = (
    PLGS_OT_set_up_engine,
    PLGS_OT_cancel_engine_set_up,
    PLGS_OT_use_this_python,
    PLGS_OT_check_engine,
    PLGS_OT_open_set_up_log,
    PLGS_OT_remove_engine,
    PLGS_OT_show_preferences,
)
