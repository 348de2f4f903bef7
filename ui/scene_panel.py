"""1 Scene: which folder, what is in it, and its cameras and images into Blender."""

from __future__ import annotations

import bpy

from ..plgs_blender.engine_environment import status
from ..plgs_blender.possibilities import possibilities
from ..plgs_blender.scene_formats import AUTOMATIC, label_of
from ..plgs_blender.scene_survey import Survey, survey_of
from ..plgs_blender.settings import place_of
from .sidebar import Sidebar, Step, from_panel, tell

_MOST_WARNINGS = 4


class PLGS_PT_scene(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_scene", "1  Scene", 1

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        row = layout.row(align=True)
        row.prop(settings, "scene_folder", text="")
        row.operator("plgs.look_at_scene", text="", icon="FILE_REFRESH")
        row.operator("plgs.browse_scene", text="", icon="IMPORT")
        survey = survey_of(place_of(settings)) if settings.scene_folder else None
        if not settings.scene_folder:
            tell(layout, context, "Choose a capture's folder or file (import), or drop one of its files here", "INFO")
        elif survey is None:
            layout.label(text="Not looked at yet", icon="QUESTION")
        else:
            _draw_survey(layout, context, survey)
        from_panel(layout.row(), context).operator("plgs.import_scene", icon="OUTLINER_OB_CAMERA")


class PLGS_PT_scene_options(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_scene_options", "Format, masks and axes"
    bl_parent_id, bl_options = "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(settings, "format")
        layout.prop(settings, "masks")
        survey = survey_of(place_of(settings)) if settings.scene_folder else None
        given = settings.masks or settings.classes_table or settings.mask_format != AUTOMATIC
        if given or (survey is not None and survey.has_masks):
            layout.prop(settings, "mask_format")
            layout.prop(settings, "classes_table")
        if settings.depth or (survey is not None and survey.error is None and not survey.has_depth):
            layout.prop(settings, "depth")
        layout.prop(settings, "up")


def _draw_survey(layout: bpy.types.UILayout, context: bpy.types.Context, survey: Survey) -> None:
    if survey.error is not None:
        box = layout.box()
        box.alert = True
        tell(box, context, survey.error, "ERROR")
        tell(box, context, survey.fix)
        return
    if survey.is_looking:
        layout.label(text="Looking at the frames ...", icon="SORTTIME")
        return
    box = layout.box()
    column = box.column(align=True)
    column.label(text=label_of(survey.format), icon="FILEBROWSER")
    column.label(text=f"{survey.frames} frames, {survey.test_frames} of them held out", icon="CAMERA_DATA")
    sizes = [f"{width} x {height}" + (f" ({count})" if len(survey.sizes) > 1 else "")
             for (width, height), count in survey.sizes[:3]]  # fmt: skip
    column.label(text=", ".join(sizes), icon="IMAGE_DATA")
    column.label(text=_depth(survey), icon="EMPTY_SINGLE_ARROW")
    if survey.has_masks:
        column.label(text=f"{len(survey.classes)} classes", icon="COLOR")
    for each in possibilities(survey, status().is_usable):
        tell(box, context, f"{each.what}: {each.why}", "CHECKMARK" if each.is_possible else "X")
    for warning in survey.warnings[:_MOST_WARNINGS]:
        tell(layout, context, warning, "ERROR")
    if len(survey.warnings) > _MOST_WARNINGS:
        layout.label(text=f"and {len(survey.warnings) - _MOST_WARNINGS} more warnings", icon="BLANK1")


def _depth(survey: Survey) -> str:
    if survey.depth_range is not None:
        near, middle, far = survey.depth_range
        return f"Depth {near:.1f} to {far:.1f} m, median {middle:.1f}"
    return "Depth: known once an engine is set up" if survey.has_depth else "No depth"


CLASSES = (PLGS_PT_scene, PLGS_PT_scene_options)
