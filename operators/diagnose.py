"""What is wrong with the panel's scene, and a mended one."""

from __future__ import annotations

import bpy
from bpy.props import IntProperty, StringProperty

from ..plgs_blender import finding_picture, scene_diagnosis
from ..plgs_blender.panel_words import in_panel_words
from ..plgs_blender.paths import absolute
from ..plgs_blender.running import diagnosing, start
from ..plgs_blender.scene_diagnosis import diagnosis_of
from ..plgs_blender.settings import place_of
from .answers import CANCELLED, FINISHED, panel_of, reporting, reporting_events


def _why_not(context: bpy.types.Context) -> str | None:
    if not context.scene.plgs.scene_folder:
        return "Choose the scene's folder first"
    if scene_diagnosis.is_running():
        return "The engine is measuring already"
    # A script waits for the engine's answer; a button is grey until there is one.
    return None if panel_of(context) is None else start.why_no_engine()


class _Measuring:
    """An engine measures the panel's scene: a script waits for it, a button does not."""

    waits = True

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.waits = False
        answer: set[str] = self.execute(context)  # type: ignore[attr-defined]
        return answer


class PLGS_OT_diagnose(_Measuring, bpy.types.Operator):
    """Measure what is wrong with the scene: axes, poses, depth, intrinsics, order, drift, pictures and labels"""

    bl_idname, bl_label, bl_options = "plgs.diagnose", "Diagnose", {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = _why_not(context)
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        diagnosis = diagnosing.diagnose(context.scene.plgs, waits=self.waits)
        if diagnosis.error is not None and not diagnosis.findings:
            self.report({"ERROR"}, in_panel_words(diagnosis.error))
            return CANCELLED
        for finding in diagnosis.findings:
            self.report({"WARNING" if finding.is_wrong else "INFO"}, f"{finding.cause}: {finding.text}")
        return FINISHED


class PLGS_OT_fix_scene(_Measuring, bpy.types.Operator):
    """Write the scene with what is safe mended into a new folder, and take that; your files stay as they are"""

    bl_idname, bl_label, bl_options = "plgs.fix_scene", "Fix", {"INTERNAL"}

    folder: StringProperty(  # type: ignore[valid-type]
        name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="Where the mended scene goes, a folder that is not there yet; empty: beside the scene's",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = _why_not(context)
        if reason is None:
            known = diagnosis_of(place_of(context.scene.plgs))
            if known is not None and not known.can_be_mended:
                reason = "Nothing was found that can be mended without a doubt"
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.plgs
        folder = absolute(self.folder) if self.folder else diagnosing.free_mended_folder(place_of(settings).scene)
        diagnosis = diagnosing.diagnose(settings, folder, waits=self.waits)
        if not diagnosis.is_running and diagnosis.mended is None:
            why = diagnosis.error or "Nothing was found that can be mended without a doubt"
            self.report({"ERROR"}, in_panel_words(why))
            return CANCELLED
        self.report({"INFO"}, f"An engine writes {folder}" if diagnosis.is_running else f"PLGS: {folder}")
        return FINISHED


class PLGS_OT_show_finding(bpy.types.Operator):
    """Show the picture of a finding in an image editor"""

    bl_idname, bl_label, bl_options = "plgs.show_finding", "Show Picture", {"INTERNAL", "UNDO"}

    number: IntProperty(name="Number", min=0, options={"SKIP_SAVE"}, description="Of the finding, from 0")  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Diagnose the scene first")
        return bool(context.scene.plgs.scene_folder) and diagnosis_of(place_of(context.scene.plgs)) is not None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        known = diagnosis_of(place_of(context.scene.plgs))
        picture = known.findings[self.number].picture if known and self.number < len(known.findings) else None
        if picture is None:
            self.report({"WARNING"}, "This finding has no picture")
            return CANCELLED
        screens = [window.screen for window in context.window_manager.windows]
        image, is_shown = finding_picture.show(picture, screens)
        where = "is in the image editor" if is_shown else "is loaded: open an image editor to see it"
        self.report({"INFO"}, f"{image.name} {where}")
        return FINISHED


class PLGS_OT_cancel_diagnosis(bpy.types.Operator):
    """Stop measuring; your files stay as they are"""

    bl_idname, bl_label, bl_options = "plgs.cancel_diagnosis", "Cancel", {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Nothing is being measured")
        return scene_diagnosis.is_running()

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene_diagnosis.forget()
        return FINISHED


CLASSES = (PLGS_OT_diagnose, PLGS_OT_fix_scene, PLGS_OT_show_finding, PLGS_OT_cancel_diagnosis)
