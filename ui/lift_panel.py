"""The panel "2 Lift": how much work to spend, what it will cost, and its progress."""

from __future__ import annotations

import bpy

from ..plgs_blender import engine_environment, registry
from ..plgs_blender.cameras import camera_seen
from ..plgs_blender.errors import PlgsError, one_line
from ..plgs_blender.running import lifts
from ..plgs_blender.running.estimate import NAMES, estimate_of
from ..plgs_blender.running.lifting import followed_lift, why_no_device
from ..plgs_blender.running.lifts import Lift, LiftState
from ..plgs_blender.settings import chosen_lift, shown_preset, why_no_options
from . import sidebar

_LOG_LINES = 8
_LABEL = 0.58  # fraction of the row below *Start* for how the last lift ended; while one runs, for *Cancel*
_ICONS = {LiftState.RUNNING: "RENDER_ANIMATION", LiftState.FINISHED: "CHECKMARK", LiftState.FAILED: "ERROR"}


class PLGS_PT_lift(sidebar.StepBefore, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_lift", "2  Lift", 20

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        followed = followed_lift(settings)
        if followed is not None and followed.is_running and not followed.is_baking:
            _draw_running(layout, context, followed)
        else:
            _draw_start(layout, context, followed)
        for other in registry.running(Lift):
            if other is not followed:  # the user chose another lift, or undid the choice of this one
                text = f"{other.folder.path.name}: {other.progress.label}"
                sidebar.draw_text(layout, context, text, "RENDER_ANIMATION")
                layout.operator("plgs.watch_lift", text="Watch").lift_folder = str(other.folder.path)


class PLGS_PT_lift_options(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "Options", "PLGS_PT_lift", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        layout.use_property_split, layout.use_property_decorate = True, False
        followed = followed_lift(settings)
        is_running = followed is not None and followed.is_running and not followed.is_baking
        layout.prop(settings, "lift_folder")
        fixed = layout.column()
        fixed.enabled = not is_running
        column = fixed.column(align=True)
        for name in NAMES:
            _draw_used(column, context, name)
        column.prop(settings, "seed")
        for name in ("fit", "anyway", "bake", "keep_names"):
            fixed.prop(settings, name)
        column = layout.column(heading="During the Lift")
        column.prop(settings, "live_preview")
        column.prop(settings, "place_when_done")
        row = column.row()
        row.enabled = not is_running
        row.prop(settings, "keep_running")


class PLGS_PT_all_options(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "All Options", "PLGS_PT_lift_options", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        followed = followed_lift(settings)
        layout.enabled = followed is None or not followed.is_running or followed.is_baking
        layout.prop(settings, "device")
        layout.prop(settings, "preset_options")
        refusal = why_no_options(settings)
        if refusal is not None:
            sidebar.draw_text(layout, context, refusal, "ERROR")
        column = layout.column(align=True)
        column.scale_y = 0.7
        for name, value, is_changed in shown_preset(settings):
            column.label(text=one_line(f"{name}={value}"), icon="CHECKMARK" if is_changed else "BLANK1")


class PLGS_PT_recent_lifts(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "Recent Lifts", "PLGS_PT_lift", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        _draw_recent(self.layout)
        row = self.layout.row(align=True)
        row.operator("plgs.open_lift", text="Open Lift…", icon="FILE_FOLDER")
        row.operator("plgs.refresh_lifts", text="", icon="FILE_REFRESH")


class PLGS_MT_recent_lifts(bpy.types.Menu):
    bl_idname, bl_label = "PLGS_MT_recent_lifts", "Recent PLGS Lifts"

    def draw(self, context: bpy.types.Context) -> None:
        _draw_recent(self.layout)


def _draw_running(layout: bpy.types.UILayout, context: bpy.types.Context, followed: Lift) -> None:
    """Draw a lift's progress in as many rows as `_draw_start`, with Cancel where no late click on Start hits it."""
    folder, progress = followed.folder, followed.progress
    stage = f"Stage {progress.stage_index} of {progress.stage_count}: " if progress.stage_count > 1 else ""
    name = one_line(f"{stage}{folder.path.name}, {folder.request.preset}")
    layout.label(text=sidebar.fitted(context, name), icon="RENDER_ANIMATION")
    layout.label(text=sidebar.fitted(context, one_line(sidebar.work_of(followed))), icon="SORTTIME")
    sidebar.draw_progress(layout, followed)
    row = layout.split(factor=_LABEL, align=True)
    sidebar.draw_cancel(row, followed)
    _draw_preview(row.row(align=True), context)
    sidebar.draw_warnings(layout, context, followed)


def _draw_start(layout: bpy.types.UILayout, context: bpy.types.Context, followed: Lift | None) -> None:
    """Draw Start and how the last lift ended. Rows that come and go are below, so that the button never moves."""
    settings = context.scene.plgs
    folder, estimate = chosen_lift(settings), estimate_of(settings)
    layout.prop(settings, "preset", expand=True)
    cost = "Time and memory are not known yet"
    if estimate is not None:
        cost = f"About {sidebar.duration(estimate.seconds)}, {estimate.peak_bytes / 1e9:.1f} GB memory"
    layout.label(text=sidebar.fitted(context, cost), icon="TIME")
    row = sidebar.from_panel(layout.row(), context)
    row.scale_y = 1.4
    if followed is not None and followed.can_be_resumed:
        row.operator("plgs.resume_lift", icon="FILE_REFRESH").lift_folder = str(followed.folder.path)
    else:
        row.operator("plgs.lift_scene", icon="PLAY")
    if followed is not None:
        _draw_ending(layout, context, followed)
    elif folder is not None and (refusal := lifts.refusals.get(folder)) is not None:
        sidebar.draw_text(layout, context, refusal if isinstance(refusal, PlgsError) else str(refusal), "ERROR")
    elif folder is not None and folder not in lifts.nothing_there:
        # The opened file names this folder. It may be somebody else's, so it is read only if the user asks.
        sidebar.from_panel(layout.row(), context).operator("plgs.watch_lift", text="Look at the Lift", icon="VIEWZOOM")
    else:
        layout.label(text="Not lifted yet")
    _draw_engine(layout, context)


def _draw_recent(layout: bpy.types.UILayout) -> None:
    for lift in lifts.recent:
        text = f"{one_line(lift.folder.path.name)}: {lift.state.value}"
        button = layout.operator("plgs.watch_lift", text=text, icon=_ICONS.get(lift.state, "FILE_FOLDER"))
        button.lift_folder = str(lift.folder.path)
    if not lifts.recent:
        layout.label(text="None yet", icon="INFO")


def _in_import_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("plgs.open_lift", text="PLGS Lift (folder)")
    menu.layout.menu(PLGS_MT_recent_lifts.bl_idname)


def _beside_quit(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    if lifts.stops_with_blender(context.scene):
        menu.layout.label(text="Quitting stops the lift; you can resume it", icon="INFO")


def _draw_used(column: bpy.types.UILayout, context: bpy.types.Context, name: str) -> None:
    """Draw the value of the option `name` that a lift will use, with a button that restores the preset's."""
    row = column.row(align=True)
    row.prop(context.scene.plgs_used, name)
    if getattr(context.scene.plgs, name):
        back = row.operator("wm.context_set_int", text="", icon="LOOP_BACK")
        back.data_path, back.value = f"scene.plgs.{name}", 0


def _draw_engine(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    reason = engine_environment.why_no_engine() or why_no_device(context.scene.plgs)
    if reason is None:
        return
    box = layout.box()
    sidebar.draw_text(box, context, reason, "INFO")
    row = box.row(align=True)
    row.operator("plgs.show_preferences", icon="PREFERENCES")
    row.operator("plgs.check_engine", text="Check Again", icon="FILE_REFRESH")


def _draw_preview(row: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the live preview's switch, and a button that looks through the camera, in whose view it appears."""
    settings, view = context.scene.plgs, getattr(context.space_data, "region_3d", None)
    row.prop(settings, "live_preview", text="Preview", toggle=True, icon="HIDE_OFF")
    see = row.row(align=True)
    is_seen = view is not None and view.view_perspective == "CAMERA"
    see.enabled = bool(settings.live_preview) and camera_seen(context.scene) is not None and not is_seen
    see.operator_context = "INVOKE_REGION_WIN"  # the operator needs the view's region, not the sidebar
    see.operator("view3d.view_camera", text="", icon="VIEW_CAMERA")


def _draw_ending(layout: bpy.types.UILayout, context: bpy.types.Context, followed: Lift) -> None:
    path, error = str(followed.folder.path), followed.error
    if error is None:
        split = layout.split(factor=_LABEL, align=True)
        is_baking = followed.is_running  # a running lift has no ending
        split.label(text="Passes are being baked" if is_baking else followed.message)
        row = split.row(align=True)
    else:
        box = sidebar.draw_error(layout, context, error)
        row = box.row(align=True)
    if followed.has_result:
        row.operator("plgs.place_lift", icon="IMPORT").lift_folder = path
    if followed.is_finished and followed.folder.request.preset == "draft":
        layout.operator("plgs.refine_lift", icon="SHADERFX").lift_folder = path
    if followed.can_be_resumed:
        sidebar.from_panel(row, context).operator("plgs.lift_scene", text="Start Anew", icon="PLAY")
    if not followed.scene_is_there:
        layout.operator("plgs.find_scene", icon="VIEWZOOM").lift_folder = path
    if error is not None:
        row.operator("plgs.open_log", icon="TEXT").lift_folder = path
        sidebar.draw_log(box, followed.follower.log_lines[-_LOG_LINES:])


MENUS = (("TOPBAR_MT_file_import", "append", _in_import_menu), ("TOPBAR_MT_file", "append", _beside_quit))
