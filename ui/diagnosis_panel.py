"""What is wrong with the scene, below its step: findings with their figures, what mends them, and Fix."""

from __future__ import annotations

import bpy

from ..plgs_blender.scene_diagnosis import SceneDiagnosis, diagnosis_of
from ..plgs_blender.settings import place_of
from .sidebar import Sidebar, from_panel, tell


class PLGS_PT_diagnosis(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_diagnosis", "Diagnosis"
    bl_parent_id, bl_options = "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.plgs
        known = diagnosis_of(place_of(settings)) if settings.scene_folder else None
        row = from_panel(layout.row(align=True), context)
        row.operator("plgs.diagnose", icon="VIEWZOOM")
        row.operator("plgs.fix_scene", icon="TOOL_SETTINGS")
        if known is None:
            tell(layout, context, "Measures whether poses, depth and lens fit together", "INFO")
        elif known.is_running:
            row = layout.row()
            row.label(text="Measuring ...", icon="SORTTIME")
            row.operator("plgs.cancel_diagnosis", text="", icon="X")
        else:
            _draw_findings(layout, context, known)


def _draw_findings(layout: bpy.types.UILayout, context: bpy.types.Context, known: SceneDiagnosis) -> None:
    if known.error is not None:
        tell(layout, context, known.error, "ERROR")
    if not known.findings and known.error is None:
        tell(layout, context, f"Nothing is wrong in {known.looked} of {known.frames} frames", "CHECKMARK")
    for number, finding in enumerate(known.findings):
        box = layout.box()
        row = box.row()
        row.label(text=finding.cause.capitalize(), icon="ERROR" if finding.is_wrong else "INFO")
        if finding.picture is not None:
            row.operator("plgs.show_finding", text="", icon="IMAGE_DATA").number = number
        tell(box, context, finding.text)
        tell(box, context, finding.option, "TOOL_SETTINGS" if finding.is_mended else "BLANK1")


CLASSES = (PLGS_PT_diagnosis,)
