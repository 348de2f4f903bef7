"""The add-on's preferences: the engine's state, and the buttons that set it up."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender import registry
from ..plgs_blender.engine_environment import EngineState, status, tasks
from ..plgs_blender.engine_environment.choices import EXTENSION, TORCH_BUILDS
from ..plgs_blender.engine_environment.tasks import SetUp
from ..plgs_blender.running.adding import ADDED
from .sidebar import draw_lacking, draw_log, draw_task, draw_text

_ICONS = dict(zip(EngineState, ("QUESTION", "SORTTIME", "CHECKMARK", "ERROR", "CANCEL"), strict=True))


def _ask_again(preferences: bpy.types.AddonPreferences, context: bpy.types.Context) -> None:
    # Not a lambda in the annotation: Blender evaluates that, and its names would be unknown when it is called.
    tasks.ask_chosen()


class PLGS_AP_preferences(bpy.types.AddonPreferences):
    """The add-on's preferences, which Blender stores with its own."""

    bl_idname = EXTENSION

    # fmt: off
    engine_python: StringProperty(name="Use This Python", subtype="FILE_PATH", update=_ask_again,
        description="The Python that runs the engine. Empty: the one that 'Set Up Engine' made")
    base_python: StringProperty(name="Base Python", subtype="FILE_PATH",
        description="The Python that the engine's environment is made from. Empty: Blender's own, else another one")
    torch_build: EnumProperty(name="Torch", items=TORCH_BUILDS, default="cpu",
        description="The build of torch to download")
    index_url: StringProperty(name="Package Index",
        description="URL of the package index to download from. Empty: the one that uv or pip is configured for, and "
        "PyTorch's public index for its CPU build")
    defaults_file: StringProperty(name="Studio Defaults", subtype="FILE_PATH",
        description="TOML file with the studio's preset, masks, names, device and memory. PLGS_DEFAULTS comes first")
    # fmt: on

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        set_up = registry.latest(SetUp)
        is_running = set_up is not None and set_up.is_running
        _draw_status(layout, context, is_running)
        if not is_running:
            row = layout.row()
            row.operator("plgs.set_up_engine", icon="IMPORT")
            row.operator("plgs.check_engine", icon="FILE_REFRESH")
        if set_up is not None:
            draw_task(layout, context, set_up)
            if set_up.is_running or set_up.error is not None:
                draw_log(layout, (str(tasks.log_path()), *set_up.log_lines))
        if status().state is EngineState.READY:
            layout.operator("plgs.try_sample", icon="HOME")
        for name in ADDED:
            draw_lacking(layout, context, name)
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "engine_python")
        column.prop(self, "defaults_file")
        header, body = layout.panel("plgs_engine_details", default_closed=True)
        header.label(text="Set-Up Options")
        if body is not None:
            body.use_property_split = True
            for name in ("base_python", "torch_build", "index_url"):
                body.prop(self, name)
            row = body.row()
            row.operator("plgs.open_set_up_log", icon="TEXT")
            row.operator("plgs.remove_engine", icon="TRASH")


def _draw_status(layout: bpy.types.UILayout, context: bpy.types.Context, is_set_up_running: bool) -> None:
    engine = status()
    draw_text(layout, context, engine.message, _ICONS[engine.state])
    # Say why the button is grey, if the user needs that button.
    obstacle = None if engine.is_usable or is_set_up_running else tasks.why_no_set_up()
    fix = engine.fix.replace("in Preferences > Add-ons > PLGS", "below").replace("Python there", "Python")
    for text in (fix, engine.note, obstacle):
        if text:
            draw_text(layout, context, text, "INFO")
    if obstacle is not None and not bpy.app.online_access:
        layout.prop(context.preferences.system, "use_online_access")
    if engine.python is not None:
        draw_text(layout, context, str(engine.python), "BLANK1")
