"""The add-on's preferences: whether an engine answers, and the buttons that get one."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender.engine_environment import EngineState, session
from ..plgs_blender.engine_environment.choices import EXTENSION, TORCH_BUILDS
from .sidebar import duration, tell

_ICONS = {
    EngineState.UNKNOWN: "QUESTION",
    EngineState.CHECKING: "SORTTIME",
    EngineState.READY: "CHECKMARK",
    EngineState.MISSING: "ERROR",
    EngineState.FAILED: "CANCEL",
}
_MEGABYTE = 10**6


def _ask_again(preferences: bpy.types.AddonPreferences, context: bpy.types.Context) -> None:
    session.check()


class PLGS_AP_preferences(bpy.types.AddonPreferences):
    """Kept with Blender's own preferences."""

    bl_idname = EXTENSION

    engine_python: StringProperty(  # type: ignore[valid-type]
        name="Use this Python",
        subtype="FILE_PATH",
        update=_ask_again,
        description="The Python that runs the engine. Empty: the one that 'Set up engine' made",
    )
    base_python: StringProperty(  # type: ignore[valid-type]
        name="Base Python",
        subtype="FILE_PATH",
        description="The Python to make the engine's environment from. Empty: Blender's own, else the first that fits",
    )
    torch_build: EnumProperty(  # type: ignore[valid-type]
        name="Torch", items=TORCH_BUILDS, default="cpu", description="The build of torch to download"
    )
    index_url: StringProperty(  # type: ignore[valid-type]
        name="Package index",
        description="URL of the package index to download from. Empty: where pip looks by itself, "
        "and PyTorch's public index for its CPU build",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        _draw_status(layout, context)
        if session.progress() is None:
            row = layout.row()
            row.operator("plgs.set_up_engine", icon="IMPORT")
            row.operator("plgs.check_engine", icon="FILE_REFRESH")
        else:
            _draw_progress(layout, context)
        _draw_error(layout, context)
        self._draw_choices(layout)

    def _draw_choices(self, layout: bpy.types.UILayout) -> None:
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "engine_python")
        header, body = layout.panel("plgs_engine_details", default_closed=True)
        header.label(text="How the engine is set up")
        if body is None:
            return
        body.use_property_split = True
        for name in ("base_python", "torch_build", "index_url"):
            body.prop(self, name)
        row = body.row()
        row.operator("plgs.open_set_up_log", icon="TEXT")
        row.operator("plgs.remove_engine", icon="TRASH")


def _draw_status(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    engine = session.status()
    tell(layout, context, engine.message, _ICONS[engine.state])
    # Why its button is grey, where it is wanted.
    obstacle = session.why_no_set_up() if not engine.is_usable and session.progress() is None else None
    for text in (engine.fix, engine.note, obstacle):
        if text:
            tell(layout, context, text, "INFO")
    if engine.python is not None:
        tell(layout, context, str(engine.python), "BLANK1")


def _draw_progress(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    progress = session.progress()
    assert progress is not None
    row = layout.split(factor=0.8)
    text = f"{progress.step}/{progress.steps}  {progress.label}"
    row.progress(factor=progress.fraction, type="BAR", text=text)
    row.operator("plgs.cancel_engine_set_up", icon="CANCEL", text="Cancel")
    amount = f"{progress.bytes_on_disk / _MEGABYTE:,.0f} MB on disk, {duration(progress.elapsed_s)}"
    tell(layout, context, f"{progress.detail}: {amount}" if progress.detail else amount)
    _draw_log(layout)


def _draw_error(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    error = session.set_up_error()
    if error is None:
        return
    box = layout.box()
    tell(box, context, f"The set-up stopped: {error.what}. {error.fix}", "ERROR")
    _draw_log(box)
    box.operator("plgs.open_set_up_log", icon="TEXT")


def _draw_log(layout: bpy.types.UILayout) -> None:
    column = layout.column(align=True)
    column.scale_y = 0.7
    column.active = False
    column.label(text=str(session.log_path()))
    for line in session.log_lines():
        column.label(text=line)


CLASSES = (PLGS_AP_preferences,)
