"""The panel Lift Panoptic Masks in the sidebar's PLGS tab, and what its subpanels share."""

from __future__ import annotations

import textwrap

import bpy

from ..plgs_blender import registry
from ..plgs_blender.errors import ErrorCode, PlgsError, field_of_option, one_line, with_field_names
from ..plgs_blender.owned import KEY, lifts_in
from ..plgs_blender.registry import Task
from ..plgs_blender.running import lifts
from ..plgs_blender.running.adding import ADDED, Adding, size_of, why_lacking, why_not_added

_PIXELS_A_LETTER = 7.0  # mean width of a letter in the interface font at scale 1, in pixels
_MENDING_OPERATORS = {
    ErrorCode.NO_ENGINE: "plgs.show_preferences",
    ErrorCode.NO_MASKS: "plgs.make_masks",
    ErrorCode.NOT_FINISHED: "plgs.resume_lift",
    ErrorCode.DAMAGED: "plgs.resume_lift",
}
"""The operator of the button that fixes an error with this code."""


class Sidebar:
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "PLGS"


class PLGS_PT_lift_panoptic_masks(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_lift_panoptic_masks", "Lift Panoptic Masks"

    def draw(self, context: bpy.types.Context) -> None:
        draw_text(self.layout, context, "Turns a filmed room into named objects, mattes and meshes")
        draw_way_back(self, context)
        if has_result(context.scene):
            icon = "DISCLOSURE_TRI_DOWN" if context.scene.plgs.show_steps else "DISCLOSURE_TRI_RIGHT"
            self.layout.prop(context.scene.plgs, "show_steps", icon=icon, emboss=False)


def has_result(scene: bpy.types.Scene) -> bool:
    """Whether a lift's result was placed in the scene."""
    return any(len(root.plgs.classes) for root in lifts_in(scene))


def draw_way_back(bar: bpy.types.Panel | bpy.types.Header, context: bpy.types.Context) -> None:
    """In a passes scene, draw the button that returns to the lift's own scene."""
    if KEY in context.scene:
        bar.layout.operator("plgs.show_room", icon="LOOP_BACK")


class Step(Sidebar):
    """A subpanel for one step of the workflow; `bl_order` sorts them."""

    bl_parent_id = PLGS_PT_lift_panoptic_masks.bl_idname


class StepBefore(Step):
    """A subpanel for a step before the result, collapsed once the result is shown."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene.plgs.show_steps or bool(registry.running(lifts.Lift)) or not has_result(context.scene)


def draw_text(
    layout: bpy.types.UILayout, context: bpy.types.Context, text: str | PlgsError | OSError, icon: str = "NONE"
) -> None:
    """Draw a text of any length, wrapped to the sidebar's width, with field names in place of command-line options."""
    column = layout.column(align=True)
    for number, line in enumerate(lines_of(context, with_field_names(text))):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


def lines_of(context: bpy.types.Context, text: str) -> list[str]:
    """Return the text in lines that fit the sidebar, at least one."""
    scale = context.preferences.system.ui_scale
    return textwrap.wrap(text, max(20, int(context.region.width / (_PIXELS_A_LETTER * scale)) - 5)) or [""]


def fitted(context: bpy.types.Context, text: str) -> str:
    """Return the text's first line, with an ellipsis if there are more."""
    first, *more = lines_of(context, text)
    return f"{first}…" if more else first


def draw_task(layout: bpy.types.UILayout, context: bpy.types.Context, task: Task) -> None:
    """Draw any task: its progress and Cancel while it runs, then its error, if any, and the fix."""
    if task.is_running:
        draw_progress(layout, task)
        if task.cancel_operator:
            draw_cancel(layout, task)
    draw_news(layout, context, task)


def draw_progress(layout: bpy.types.UILayout, task: Task) -> None:
    """Draw a running task's progress bar, as high as the button that started it."""
    row = layout.row()
    row.scale_y = 1.4
    share, text = how_far(task)
    row.progress(factor=share, type="BAR", text=text)


def draw_cancel(layout: bpy.types.UILayout, task: Task) -> None:
    cancel = layout.operator(task.cancel_operator, icon="CANCEL")
    if task.lift_folder is not None:
        cancel.lift_folder = str(task.lift_folder)


def draw_bar(cell: bpy.types.UILayout, task: Task | None, name: str) -> bool:
    """While a task runs, draw its progress and a cross in place of its button. Returns whether one runs."""
    if task is None or not task.is_running:
        return False
    share, _ = how_far(task)
    cell.progress(factor=share, type="BAR", text=f"{name} {100 * share:.0f} %")
    cell.operator(task.cancel_operator, text="", icon="X")
    return True


def draw_news(layout: bpy.types.UILayout, context: bpy.types.Context, task: Task) -> None:
    """Draw a running task's messages, or after its end its error and the fix."""
    if not task.is_running:
        if task.error is not None:
            draw_error(layout, context, task.error)
        return
    progress = task.progress
    stages = f"{progress.stage_index}/{progress.stage_count}  " if progress.stage_count > 1 else ""
    draw_text(layout, context, f"{stages}{work_of(task)}", "SORTTIME")
    draw_warnings(layout, context, task)


def draw_warnings(layout: bpy.types.UILayout, context: bpy.types.Context, task: Task) -> None:
    """Draw the latest warnings of a running task."""
    for warning in task.progress.warnings[-2:]:
        draw_text(layout, context, warning, "ERROR")


def work_of(task: Task) -> str:
    """Return a text about what a running task is doing."""
    progress = task.progress
    if progress.stage == "train" and not progress.step:
        return "First step (may compile for 2 min)"  # kernels are compiled once per computer
    loss = "" if progress.loss is None else f", loss {progress.loss:.4f}"
    return f"{progress.label if progress.stage else task.label}{loss}"


def draw_error(layout: bpy.types.UILayout, context: bpy.types.Context, error: PlgsError) -> bpy.types.UILayout:
    """Draw an error with the fields that it names and the button that fixes it, and return the box."""
    box = layout.box()
    is_offer = error.code is ErrorCode.LACKS_PART or error.option == "--download"
    box.alert = not is_offer  # a download is a question, not a fault
    lines: list[str | PlgsError] = [*with_field_names(error).split("; ")] if is_offer else [error]
    for number, line in enumerate(lines):
        draw_text(box, context, line, "ERROR" if not is_offer else "DOT" if number else "IMPORT")
    if error.code is ErrorCode.LACKS_PART and error.option in ADDED:
        draw_adding(box, context, error.option)
        return box
    for field in filter(None, map(field_of_option, error.option.split())):
        box.prop(context.scene.plgs, field)
    if error.code in _MENDING_OPERATORS:
        from_panel(box.row(), context).operator(_MENDING_OPERATORS[error.code])
    return box


def draw_lacking(layout: bpy.types.UILayout, context: bpy.types.Context, name: str) -> None:
    """If the engine lacks packages for a capability, draw which, and the button that adds them."""
    reason = why_lacking(name)
    if reason is not None:
        draw_text(layout, context, reason, "INFO")
        draw_adding(layout, context, name)


def draw_adding(layout: bpy.types.UILayout, context: bpy.types.Context, name: str) -> None:
    """Draw the button that adds packages to the engine, or its progress, or why it failed."""
    adding = registry.latest(Adding)
    if adding is not None and adding.name == name:
        draw_task(layout, context, adding)
    if adding is None or not adding.is_running:
        row = layout.row(align=True)
        button = row.operator("plgs.add_to_engine", text=f"Add to Engine ({amount(size_of(name))})", icon="IMPORT")
        button.capability = name
        row.operator("plgs.check_engine", text="", icon="FILE_REFRESH")  # for users who installed the packages by hand
        if (obstacle := why_not_added()) is not None:
            draw_text(layout, context, obstacle, "INFO")


def how_far(task: Task) -> tuple[float, str]:
    """Return a task's completed fraction (of the whole if the engine estimates it, else of the stage), and a text such
    as "3 of 8" or the time left."""
    progress, took, left = task.progress, task.took_s, task.left_s
    if left is not None:
        share = took / max(took + left, 1e-9)  # both may be 0
        return share, f"{100 * share:.0f} %, {duration(left)} left" if left >= 1.0 else "Almost done"
    if not 0 < progress.step < progress.steps:  # before the first step, and after the last one of a stage
        return float(progress.step > 0), duration(took)
    share = progress.step / progress.steps
    counted = f"{progress.step} of {progress.steps}" if task.counts_steps else f"{100 * share:.0f} %"
    return share, counted if progress.eta_s is None else f"{counted}, {duration(progress.eta_s)} left"


def from_panel(layout: bpy.types.UILayout, context: bpy.types.Context) -> bpy.types.UILayout:
    """A layout whose buttons are grey if the panel's settings forbid them. Scripts are judged by their arguments."""
    layout.context_pointer_set("plgs_panel", context.scene.plgs)
    return layout


def draw_log(layout: bpy.types.UILayout, lines: tuple[str, ...]) -> None:
    """Draw the lines, the end of a log, in small text."""
    column = layout.column(align=True)
    column.scale_y = 0.7
    column.active = False
    for line in lines:
        column.label(text=one_line(line))


def duration(seconds: float) -> str:
    """Return a duration such as "2 min 40 s" or "1 h 05 min"."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def amount(size: float) -> str:
    """Return a number of bytes as "80 MB" or "2.1 GB"."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


MENUS = (("NODE_HT_header", "append", draw_way_back),)
