"""The panel "1 Scene": its folder, contents, problems and masks, and importing its cameras and images."""

from __future__ import annotations

from typing import Any

import bpy

from ..plgs_blender import registry
from ..plgs_blender.cameras import PHOTO, SHOWN
from ..plgs_blender.chosen_scene import label_of
from ..plgs_blender.engine_environment import status
from ..plgs_blender.errors import ErrorCode, one_line, plural, sentence, with_field_names
from ..plgs_blender.frame_pictures import DEPTH, MASKS, range_shown, why_no_picture
from ..plgs_blender.owned import LIFT, lifts_in
from ..plgs_blender.running.diagnosis import Diagnosis, diagnosis_of
from ..plgs_blender.running.importing import FrameMaking
from ..plgs_blender.running.preparation import DepthMaking, FilmMaking, MaskMaking, PoseMaking, ScaleSetting
from ..plgs_blender.running.survey import SceneLook, Survey, obstacles_to, survey_of_panel
from ..plgs_blender.settings import chosen_scene
from . import sidebar

_FACTS = ("CAMERA_DATA", "IMAGE_DATA", "EMPTY_SINGLE_ARROW", "COLOR")
"""Icons of the facts shown for every scene: frames, size, depth and masks."""
_MOST_LINKS, _LINKS_IN_A_ROW = 12, 4
_PICTURES = ((PHOTO, "Photo", "IMAGE_DATA"), (DEPTH, "Depth", "EMPTY_SINGLE_ARROW"), (MASKS, "Masks", "COLOR"))


class PLGS_PT_scene(sidebar.StepBefore, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_scene", "1  Scene", 10

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        row = layout.row(align=True)
        row.prop(settings, "scene_folder", text="")
        row.operator("plgs.look_at_scene", text="", icon="FILE_REFRESH")
        row.operator("plgs.browse_scene", text="", icon="IMPORT")
        # Above the summary, which comes a moment later: nothing should move under the pointer.
        row, making = sidebar.from_panel(layout.row(align=True), context), registry.latest(FrameMaking)
        if making is None or not _is_import(making, context) or not sidebar.draw_bar(row, making, "Images"):
            row.operator("plgs.import_scene", icon="OUTLINER_OB_CAMERA")
        film = registry.latest(FilmMaking)
        if film is not None and (film.is_running or (settings.scene_folder and film.error_for(chosen_scene(settings)))):
            sidebar.draw_task(layout, context, film)  # its events are about a film, which is no scene yet
            return
        survey = survey_of_panel(settings)
        if not settings.scene_folder:
            what_to_do = "Choose a capture's folder or file, or drop one of its files here"
            sidebar.draw_text(layout, context, what_to_do, "INFO")
            layout.operator("plgs.try_sample", icon="HOME")
        elif survey is not None and survey.error is not None:
            box = sidebar.draw_error(layout, context, survey.error)
            if survey.error.code is ErrorCode.NO_POSES:
                _draw_poses(box, context)
        else:
            _draw_survey(layout, context, survey)


class PLGS_PT_scene_options(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "Import Options", "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in ("format", "masks", "mask_format", "detections", "classes_table", "depth", "up"):
            layout.prop(settings, name)
        _draw_depth(layout, context)


class PLGS_UL_mask_classes(bpy.types.UIList):
    def draw_item(
        self, _context: Any, layout: Any, _masks: Any, row: Any, _icon: int, _active: Any, _name: str
    ) -> None:
        line = layout.row(align=True)
        line.prop(row, "name", text="", emboss=False)
        line.prop(row, "into", text="", icon="FORWARD")
        line.prop(row, "is_thing", text="")


class PLGS_PT_scene_masks(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "Masks and Classes", "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, masks = self.layout, context.scene.plgs, context.scene.plgs_masks
        making = registry.latest(MaskMaking)
        layout.prop(masks, "known")
        layout.prop(masks, "model")
        if making is not None and making.is_running:
            sidebar.draw_task(layout, context, making)
        else:
            sidebar.from_panel(layout.row(), context).operator("plgs.make_masks", icon="MOD_MASK")
            sidebar.draw_lacking(layout, context, "segment")
            if making is not None and settings.scene_folder and making.error_for(chosen_scene(settings)) is not None:
                sidebar.draw_task(layout, context, making)
        row = layout.row(align=True)
        row.operator("plgs.read_classes", icon="FILE_REFRESH")
        row.operator_menu_enum("plgs.read_classes", "table", text="", icon="DOWNARROW_HLT")
        if len(masks.classes):
            layout.template_list("PLGS_UL_mask_classes", "", masks, "classes", masks, "active", rows=5)
            layout.operator("plgs.write_classes", icon="FILE_TICK")


class PLGS_PT_diagnosis(sidebar.Sidebar, bpy.types.Panel):
    bl_label, bl_parent_id, bl_options = "Diagnosis", "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        known = diagnosis_of(chosen_scene(settings)) if settings.scene_folder else None
        row = sidebar.from_panel(layout.row(align=True), context)
        row.operator("plgs.diagnose", icon="VIEWZOOM")
        row.operator("plgs.fix_scene", icon="TOOL_SETTINGS")
        if known is None:
            sidebar.draw_text(layout, context, "Checks whether poses, depth and lens fit together", "INFO")
            return
        sidebar.draw_task(layout, context, known)
        if not known.is_running:
            _draw_findings(layout, context, known)


class PLGS_PT_frames(sidebar.Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_frames", "Frames", 15

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Show the panel always: without a frame's camera its buttons are grey, so that nothing below them moves."""
        return bool(context.scene.plgs.scene_folder) or bool(lifts_in(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        ob = context.scene.camera if why_no_picture(context.scene) is None else None
        row = layout.row(align=True)
        for what, label, icon in _PICTURES:
            is_shown = ob is not None and ob.get(SHOWN, PHOTO) == what
            row.operator("plgs.show_picture", text=label, icon=icon, depress=is_shown).what = what
        making, span = registry.latest(FrameMaking), None if ob is None else range_shown(ob)
        if making is not None and making.is_running and not _is_import(making, context):
            sidebar.draw_bar(layout.row(align=True), making, "Images")
        elif span is not None:
            layout.label(text=f"{span[0]:.2f} m (light) to {span[1]:.2f} m (dark)", icon="BLANK1")
        if making is not None and making.is_running:
            sidebar.draw_warnings(layout, context, making)
        elif making is not None:
            settings, eye = context.scene.plgs, context.scene.camera
            chosen = chosen_scene(settings) if settings.scene_folder else None
            if making.error_for(chosen, "" if eye is None else eye.get(LIFT, "")) is not None:
                sidebar.draw_news(layout, context, making)


def _draw_poses(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    making = registry.latest(PoseMaking)
    if making is not None and making.is_running:
        layout.alert = False  # in the error's red box
        sidebar.draw_task(layout, context, making)
        return
    if making is not None and making.error_for(chosen_scene(context.scene.plgs)) is not None:
        sidebar.draw_task(layout, context, making)
    layout.operator("plgs.make_poses", icon="TRACKING_FORWARDS")
    sidebar.draw_lacking(layout, context, "colmap")


def _draw_depth(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw Make Depth, for a scene without depth, and Set Scale, for one without a unit; or their progress."""
    buttons = (DepthMaking, "plgs.make_depth", "MOD_MESHDEFORM"), (ScaleSetting, "plgs.set_scale", "FULLSCREEN_ENTER")
    for kind, name, icon in buttons:
        making = registry.latest(kind)
        if making is not None and making.is_running:
            sidebar.draw_task(layout, context, making)
        else:
            layout.operator(name, icon=icon)
            if making is not None and making.error_for(chosen_scene(context.scene.plgs)) is not None:
                sidebar.draw_task(layout, context, making)


def _draw_survey(layout: bpy.types.UILayout, context: bpy.types.Context, survey: Survey | None) -> None:
    """Draw the scene summary in a fixed number of rows, so that nothing moves as it is read."""
    if survey is None:
        layout.label(text="Not read yet: press the arrows", icon="QUESTION")
        return
    known = None if survey.is_looking else survey
    column = layout.box().column(align=True)
    if known is None:
        looks = [sidebar.how_far(look)[0] for look in registry.running(SceneLook)]
        column.progress(factor=max(looks, default=0.0), type="BAR", text="Reading the scene")
    else:
        column.label(text=label_of(known.format), icon="FILEBROWSER")
    facts = ("",) * len(_FACTS) if known is None else _facts(known)
    for icon, fact in zip(_FACTS, facts, strict=True):
        column.label(text=fact, icon=icon if fact else "BLANK1")
    warnings = () if known is None else (*(text for text, doubtful in known.inferred if doubtful), *known.warnings)
    header, body = layout.panel("plgs_scene_details", default_closed=True)
    # The header shows the first warning; opening it shows its end and the others.
    first = f"{plural(len(warnings), 'warning')}: {warnings[0]}" if warnings else "Details"
    header.label(text=sidebar.fitted(context, with_field_names(first)), icon="ERROR" if warnings else "NONE")
    if body is not None and known is not None:
        _draw_details(body, context, known, warnings)


def _facts(survey: Survey) -> tuple[str, ...]:
    """Return one line for each of `_FACTS`, short enough for the default width of the sidebar."""
    frames = plural(survey.frames, "frame")
    if survey.left_out:
        frames += f", {survey.left_out} left out"
    sizes = [f"{width} x {height}" + (f" ({count})" if len(survey.sizes) > 1 else "")
             for (width, height), count in survey.sizes[:2]]  # fmt: skip
    depth = "Depth maps, range not read" if survey.has_depth else "No depth: make or choose it below"
    if survey.depth_range is not None:
        depth = "Depth {:.1f} to {:.1f} m, median {:.1f}".format(*(survey.depth_range[place] for place in (0, 2, 1)))
    masks = "Masks: read when a lift starts"
    if survey.has_masks is not None:
        masks = plural(len(survey.classes), "class", "classes") if survey.has_masks else "No masks: make them below"
    return frames, ", ".join(sizes) + (", ..." if len(survey.sizes) > 2 else ""), depth, masks


def _draw_details(
    layout: bpy.types.UILayout, context: bpy.types.Context, survey: Survey, warnings: tuple[str, ...]
) -> None:
    held_out = plural(survey.test_frames, "frame")
    sidebar.draw_text(layout, context, f"{held_out} held out of training, to score the lift", "INFO")
    obstacles = obstacles_to(survey, status().is_usable)
    possible = ", ".join(what for what, why_not in obstacles.items() if why_not is None)
    sidebar.draw_text(layout, context, f"Possible: {possible.lower()}", "CHECKMARK")
    for what, why_not in obstacles.items():
        if why_not is not None:
            sidebar.draw_text(layout, context, f"{what}: {why_not}", "X")
    for warning in warnings:
        sidebar.draw_text(layout, context, sentence(warning), "ERROR")
    for text, is_doubtful in survey.inferred:
        if not is_doubtful:
            sidebar.draw_text(layout, context, text, "INFO")


def _draw_findings(layout: bpy.types.UILayout, context: bpy.types.Context, known: Diagnosis) -> None:
    if not known.findings and known.error is None:
        checked = f"{known.looked} of {known.frames} frames"
        sidebar.draw_text(layout, context, f"No problem found; checked {checked}", "CHECKMARK")
    for number, finding in enumerate(known.findings):
        box = layout.box()
        row = box.row()
        sidebar.draw_text(row, context, finding.cause.capitalize(), "ERROR" if finding.is_wrong else "INFO")
        if finding.picture is not None:
            row.operator("plgs.show_finding", text="", icon="IMAGE_DATA").number = number
        sidebar.draw_text(box, context, finding.text)
        if finding.frames:
            _draw_links(box, finding.frames, number)
        sidebar.draw_text(box, context, finding.option, "TOOL_SETTINGS" if finding.is_mended else "BLANK1")
        if known.split is not None and finding.leave_out:
            if known.split.has_any(finding.leave_out):
                text = f"Leave Out {plural(len(finding.leave_out), 'Frame')}"
                box.operator("plgs.leave_out", text=text, icon="REMOVE").number = number
            else:
                box.label(text="Left out by splits.json", icon="CHECKMARK")


def _draw_links(layout: bpy.types.UILayout, frames: tuple[str, ...], number: int) -> None:
    grid = layout.grid_flow(row_major=True, columns=_LINKS_IN_A_ROW, even_columns=True, align=True)
    for frame in frames[:_MOST_LINKS]:
        button = grid.operator("plgs.go_to_finding", text=one_line(frame))
        button.number, button.frame = number, frame
    if len(frames) > _MOST_LINKS:
        layout.label(text=f"and {len(frames) - _MOST_LINKS} more", icon="BLANK1")


def _is_import(making: FrameMaking, context: bpy.types.Context) -> bool:
    """Whether a task imports the panel's scene now, rather than another scene or one frame's picture."""
    settings, order = context.scene.plgs, making.order
    is_of_scene = bool(settings.scene_folder) and order.chosen == chosen_scene(settings)
    return making.is_running and is_of_scene and not order.frame


def _draw_import_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator_context = "INVOKE_DEFAULT"
    menu.layout.operator("plgs.import_film", text="PLGS Film (.mp4, .mov) or Folder of Photos")
    menu.layout.operator("plgs.browse_scene", text="PLGS Scene (ScanNet, COLMAP, transforms.json, .sens, .r3d ...)")


MENUS = (("TOPBAR_MT_file_import", "append", _draw_import_menu),)
