"""1 Scene: its folder, contents, problems and masks, and importing its cameras and images."""

from __future__ import annotations

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
from ..plgs_blender.running.preparation import MaskMaking, PoseMaking
from ..plgs_blender.running.survey import SceneLook, Survey, possibilities, survey_of_panel
from ..plgs_blender.settings import chosen_scene
from .sidebar import (
    Sidebar,
    Step,
    StepBefore,
    draw_bar,
    draw_error,
    draw_lacking,
    draw_news,
    draw_task,
    draw_text,
    draw_warnings,
    fitted,
    from_panel,
    how_far,
)

_FACTS = ("CAMERA_DATA", "IMAGE_DATA", "EMPTY_SINGLE_ARROW", "COLOR")
"""Icons of the facts shown for every scene: frames, size, depth and masks."""
_MOST_LINKS, _LINKS_IN_A_ROW = 12, 4
_PICTURES = ((PHOTO, "Photo", "IMAGE_DATA"), (DEPTH, "Depth", "EMPTY_SINGLE_ARROW"), (MASKS, "Masks", "COLOR"))


class PLGS_PT_scene(StepBefore, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_scene", "1  Scene", 10

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        row = layout.row(align=True)
        row.prop(settings, "scene_folder", text="")
        row.operator("plgs.look_at_scene", text="", icon="FILE_REFRESH")
        row.operator("plgs.browse_scene", text="", icon="IMPORT")
        # Above what is read: that comes a moment later, and nothing is to move under the pointer.
        row, making = from_panel(layout.row(align=True), context), registry.latest(FrameMaking)
        if making is not None and _is_import(making, context):
            draw_bar(row, making, "Images")
        else:
            row.operator("plgs.import_scene", icon="OUTLINER_OB_CAMERA")
        survey = survey_of_panel(settings)
        if not settings.scene_folder:
            draw_text(layout, context, "Choose a capture's folder or file, or drop one of its files here", "INFO")
        elif survey is not None and survey.error is not None:
            box = draw_error(layout, context, survey.error)
            if survey.error.code is ErrorCode.NO_POSES:
                _draw_poses(box, context)
        else:
            _draw_survey(layout, context, survey)


class PLGS_PT_scene_options(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_scene_options", "Format, Masks and Axes"
    bl_parent_id, bl_options = "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(settings, "format")
        layout.prop(settings, "masks")
        for name in ("mask_format", "detections", "classes_table", "depth", "up"):
            layout.prop(settings, name)


class PLGS_UL_mask_classes(bpy.types.UIList):
    """The name of a class, the class that it counts as, and whether that is a thing."""

    def draw_item(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, data: object, item: bpy.types.PropertyGroup,
        icon: int, active_data: object, active_property: str, index: int = 0, flag: int = 0,
    ) -> None:  # fmt: skip
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False)
        row.prop(item, "into", text="", icon="FORWARD")
        row.prop(item, "is_thing", text="")


class PLGS_PT_scene_masks(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_scene_masks", "Masks and Classes"
    bl_parent_id, bl_options = "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, masks = self.layout, context.scene.plgs, context.scene.plgs_masks
        making = registry.latest(MaskMaking)
        layout.prop(masks, "model")
        if making is not None and making.is_running:
            draw_task(layout, context, making)
        else:
            from_panel(layout.row(), context).operator("plgs.make_masks", icon="MOD_MASK")
            draw_lacking(layout, context, "segment")
            if making is not None and settings.scene_folder and making.error_for(chosen_scene(settings)) is not None:
                draw_task(layout, context, making)
        row = layout.row(align=True)
        row.operator("plgs.read_classes", icon="FILE_REFRESH")
        row.operator_menu_enum("plgs.read_classes", "table", text="", icon="DOWNARROW_HLT")
        if len(masks.classes):
            layout.template_list("PLGS_UL_mask_classes", "", masks, "classes", masks, "active", rows=5)
            layout.operator("plgs.write_classes", icon="FILE_TICK")


class PLGS_PT_diagnosis(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_diagnosis", "Diagnosis"
    bl_parent_id, bl_options = "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        known = diagnosis_of(chosen_scene(settings)) if settings.scene_folder else None
        row = from_panel(layout.row(align=True), context)
        row.operator("plgs.diagnose", icon="VIEWZOOM")
        row.operator("plgs.fix_scene", icon="TOOL_SETTINGS")
        if known is None:
            draw_text(layout, context, "Checks whether poses, depth and lens fit together", "INFO")
            return
        draw_task(layout, context, known)
        if not known.is_running:
            _draw_findings(layout, context, known)


class PLGS_PT_frames(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_frames", "Frames", 15

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The buttons are grey, not hidden, before an import or a lift brings frames and while the active camera is not
        a frame's. So nothing below moves, and buttons that go to a frame stay under the mouse."""
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
            draw_bar(layout.row(align=True), making, "Images")
        elif span is not None:
            layout.label(text=f"{span[0]:.2f} m (light) to {span[1]:.2f} m (dark)", icon="BLANK1")
        if making is not None and making.is_running:
            draw_warnings(layout, context, making)
        elif making is not None and _is_failure_of(making, context):
            draw_news(layout, context, making)


def _draw_poses(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button that finds poses with what the engine lacks for it, or the progress."""
    making = registry.latest(PoseMaking)
    if making is not None and making.is_running:
        layout.alert = False
        draw_task(layout, context, making)
        return
    if making is not None and making.error_for(chosen_scene(context.scene.plgs)) is not None:
        draw_task(layout, context, making)
    layout.operator("plgs.make_poses", icon="TRACKING_FORWARDS")
    draw_lacking(layout, context, "colmap")


def _draw_survey(layout: bpy.types.UILayout, context: bpy.types.Context, survey: Survey | None) -> None:
    """Draw the scene summary in a fixed number of rows, so that nothing moves as it is read."""
    known = survey if survey is not None and not survey.is_looking else None
    if survey is None:
        layout.label(text="Not read yet: press the arrows", icon="QUESTION")
        return
    column = layout.box().column(align=True)
    if known is None:
        looks = [how_far(look)[0] for look in registry.running(SceneLook)]
        column.progress(factor=max(looks, default=0.0), type="BAR", text="Reading the scene")
    else:
        column.label(text=label_of(known.format), icon="FILEBROWSER")
    facts = ("",) * len(_FACTS) if known is None else _facts(known)
    for icon, fact in zip(_FACTS, facts, strict=True):
        column.label(text=fact, icon=icon if fact else "BLANK1")
    warnings = () if known is None else (*(text for text, doubtful in known.inferred if doubtful), *known.warnings)
    header, body = layout.panel("plgs_scene_details", default_closed=True)
    # A guess or a warning is seen without a click; more than one, and the end of a long one, by opening this.
    first = f"{plural(len(warnings), 'warning')}: {warnings[0]}" if warnings else "Details"
    header.label(text=fitted(context, with_field_names(first)), icon="ERROR" if warnings else "NONE")
    if body is not None and known is not None:
        _draw_details(body, context, known, warnings)


def _facts(survey: Survey) -> tuple[str, ...]:
    """One line for each of `_FACTS`, short enough for the default width of the sidebar."""
    frames = plural(survey.frames, "frame")
    if survey.left_out:
        frames += f", {survey.left_out} left out"
    sizes = [f"{width} x {height}" + (f" ({count})" if len(survey.sizes) > 1 else "")
             for (width, height), count in survey.sizes[:2]]  # fmt: skip
    depth = "Depth maps, range not read" if survey.has_depth else "No depth: give it below"
    if survey.depth_range is not None:
        depth = "Depth {:.1f} to {:.1f} m, median {:.1f}".format(*(survey.depth_range[place] for place in (0, 2, 1)))
    masks = "Masks: read when a lift starts"
    if survey.has_masks is not None:
        masks = plural(len(survey.classes), "class", "classes") if survey.has_masks else "No masks: make them below"
    return frames, ", ".join(sizes) + (", ..." if len(survey.sizes) > 2 else ""), depth, masks


def _draw_details(
    layout: bpy.types.UILayout, context: bpy.types.Context, survey: Survey, warnings: tuple[str, ...]
) -> None:
    draw_text(layout, context, f"{plural(survey.test_frames, 'frame')} held out of training, to score the lift", "INFO")
    known = possibilities(survey, status().is_usable)
    possible = ", ".join(each.what for each in known if each.is_possible)
    draw_text(layout, context, f"Possible: {possible.lower()}", "CHECKMARK")
    for each in known:
        if not each.is_possible:
            draw_text(layout, context, f"{each.what}: {each.why}", "X")
    for warning in warnings:
        draw_text(layout, context, sentence(warning), "ERROR")
    for text, is_doubtful in survey.inferred:
        if not is_doubtful:
            draw_text(layout, context, text, "INFO")


def _draw_findings(layout: bpy.types.UILayout, context: bpy.types.Context, known: Diagnosis) -> None:
    if not known.findings and known.error is None:
        draw_text(layout, context, f"No problem found; checked {known.looked} of {known.frames} frames", "CHECKMARK")
    for number, finding in enumerate(known.findings):
        box = layout.box()
        row = box.row()
        draw_text(row, context, finding.cause.capitalize(), "ERROR" if finding.is_wrong else "INFO")
        if finding.picture is not None:
            row.operator("plgs.show_finding", text="", icon="IMAGE_DATA").number = number
        draw_text(box, context, finding.text)
        _draw_links(box, finding.frames, number)
        draw_text(box, context, finding.option, "TOOL_SETTINGS" if finding.is_mended else "BLANK1")
        if known.split is not None and finding.leave_out:
            if known.split.has_any(finding.leave_out):
                text = f"Leave Out {plural(len(finding.leave_out), 'Frame')}"
                box.operator("plgs.leave_out", text=text, icon="REMOVE").number = number
            else:
                box.label(text="Left out by splits.json", icon="CHECKMARK")


def _draw_links(layout: bpy.types.UILayout, frames: tuple[str, ...], number: int) -> None:
    """Draw a button for each of a finding's first frames that goes to its camera."""
    if not frames:
        return
    grid = layout.grid_flow(row_major=True, columns=_LINKS_IN_A_ROW, even_columns=True, align=True)
    for frame in frames[:_MOST_LINKS]:
        button = grid.operator("plgs.go_to_finding", text=one_line(frame))
        button.number, button.frame = number, frame
    if len(frames) > _MOST_LINKS:
        layout.label(text=f"and {len(frames) - _MOST_LINKS} more", icon="BLANK1")


def _is_import(making: FrameMaking, context: bpy.types.Context) -> bool:
    """Whether a task imports the panel's scene now. Buttons stay while one frame's picture or another scene is made."""
    settings, order = context.scene.plgs, making.order
    is_of_scene = bool(settings.scene_folder) and order.chosen == chosen_scene(settings)
    return making.is_running and is_of_scene and not order.frame


def _is_failure_of(making: FrameMaking, context: bpy.types.Context) -> bool:
    """Whether a task that makes frames failed for the panel's scene or the active camera's."""
    settings, ob = context.scene.plgs, context.scene.camera
    chosen = chosen_scene(settings) if settings.scene_folder else None
    return making.error_for(chosen, "" if ob is None else ob.get(LIFT, "")) is not None


def _draw_import_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("plgs.browse_scene", text="PLGS Scene (ScanNet, COLMAP, transforms.json, .sens, .r3d ...)")


CLASSES = (
    PLGS_PT_scene,
    PLGS_PT_frames,
    PLGS_PT_scene_options,
    PLGS_UL_mask_classes,
    PLGS_PT_scene_masks,
    PLGS_PT_diagnosis,
)
MENUS = (("TOPBAR_MT_file_import", "append", _draw_import_menu),)
