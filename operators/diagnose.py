"""Diagnosing the panel's scene, and writing a fixed copy of it."""

from __future__ import annotations

import bpy
from bpy.props import IntProperty, StringProperty

from ..plgs_blender.engine_environment import why_no_engine
from ..plgs_blender.errors import with_field_names
from ..plgs_blender.paths import absolute, free_folder
from ..plgs_blender.running.diagnosis import Diagnosis, Finding, diagnose, diagnosis_of
from ..plgs_blender.settings import chosen_scene
from ..plgs_blender.tasks import registry
from ..plgs_blender.tasks.registry import Task
from ..plgs_blender.viewport import show_finding
from .base import CANCELLED, FINISHED, CancelsTask, Explained, StartsTask, panel_of, reporting

_NOTHING = "Nothing was found that can safely be fixed"


class Measures(StartsTask):
    """An operator that has an engine measure the panel's scene."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if not context.scene.plgs.scene_folder:
            return "Choose the scene's folder first"
        if registry.running(Diagnosis):
            return "The engine is already measuring"
        # A script waits for the engine's answer; a button is grey until there is one.
        return None if panel_of(context) is None else why_no_engine()


class PLGS_OT_diagnose(Measures, bpy.types.Operator):
    """Check the scene for problems: axes, poses, depth, intrinsics, order, drift, pictures and labels"""

    bl_idname, bl_label, bl_options = "plgs.diagnose", "Diagnose", {"INTERNAL"}

    def begin(self, context: bpy.types.Context) -> Task:
        return diagnose(context.scene.plgs)

    def tell(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        findings = task.findings if isinstance(task, Diagnosis) else ()
        for finding in findings:
            self.report({"WARNING" if finding.is_wrong else "INFO"}, f"{finding.cause}: {finding.text}")
        return FINISHED if findings else super().tell(context, task)


class PLGS_OT_fix_scene(Measures, bpy.types.Operator):
    """Write a copy of the scene with all safe fixes into a new folder, and use that copy; your files do not change"""

    bl_idname, bl_label, bl_options = "plgs.fix_scene", "Fix", {"INTERNAL"}

    folder: StringProperty(  # type: ignore[valid-type]
        name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="Where the fixed scene goes: a folder that does not exist yet; empty: beside the scene's folder",
    )  # fmt: skip

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        reason = super().why_not(context)
        known = None if reason is not None else diagnosis_of(chosen_scene(context.scene.plgs))
        return reason if known is None or known.can_be_mended else _NOTHING

    def begin(self, context: bpy.types.Context) -> Task:
        settings = context.scene.plgs
        scene = chosen_scene(settings).scene
        return diagnose(settings, absolute(self.folder) if self.folder else free_folder(scene, "mended"))

    def tell(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        assert isinstance(task, Diagnosis)
        if task.is_running:
            self.report({"INFO"}, f"An engine is writing {task.mended}")
            return FINISHED
        if not task.is_mended:
            self.report({"ERROR"}, _NOTHING if task.error is None else with_field_names(task.error))
            return CANCELLED
        self.report({"INFO"}, f"PLGS: {task.mended}")
        return FINISHED


class PLGS_OT_show_finding(Explained, bpy.types.Operator):
    """Show the picture of a finding in an image editor"""

    bl_idname, bl_label, bl_options = "plgs.show_finding", "Show Picture", {"INTERNAL", "UNDO"}

    number: IntProperty(name="Number", min=0, options={"SKIP_SAVE"}, description="Number of the finding, from 0")  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return None if _findings(context) else "Diagnose the scene first"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        findings = _findings(context)
        picture = findings[self.number].picture if self.number < len(findings) else None
        if picture is None:
            self.report({"WARNING"}, "This finding has no picture")
            return CANCELLED
        screens = [window.screen for window in context.window_manager.windows]
        image, is_shown = show_finding(picture, screens)
        where = "is in the image editor" if is_shown else "is loaded: open an image editor to see it"
        self.report({"INFO"}, f"{image.name} {where}")
        return FINISHED


class PLGS_OT_cancel_diagnosis(CancelsTask, bpy.types.Operator):
    """Stop measuring; your files do not change"""

    bl_idname, bl_label, bl_options = "plgs.cancel_diagnosis", "Cancel", {"INTERNAL"}
    cancelled_kind = Diagnosis


def _findings(context: bpy.types.Context) -> tuple[Finding, ...]:
    """What is known about the panel's scene."""
    settings = context.scene.plgs
    known = diagnosis_of(chosen_scene(settings)) if settings.scene_folder else None
    return () if known is None else known.findings


CLASSES = (PLGS_OT_diagnose, PLGS_OT_fix_scene, PLGS_OT_show_finding, PLGS_OT_cancel_diagnosis)
