"""Operators that prepare a lift: poses for photos, masks and their classes, diagnosis, and a fixed copy."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from mathutils import Vector

from ..plgs_blender import registry
from ..plgs_blender.chosen_scene import absolute, free_folder
from ..plgs_blender.engine_environment import usable_python, why_no_engine
from ..plgs_blender.errors import PlgsError, plural, with_field_names
from ..plgs_blender.inspecting.views import look_from_frame
from ..plgs_blender.owned import SCENE, is_same_place, lifts_in, text_of
from ..plgs_blender.registry import Task
from ..plgs_blender.running import preparation
from ..plgs_blender.running.adding import why_lacking
from ..plgs_blender.running.diagnosis import Diagnosis, Finding, diagnose, diagnosis_of, leave_out
from ..plgs_blender.running.preparation import FILMS, DepthMaking, FilmMaking, MaskMaking, PoseMaking
from ..plgs_blender.settings import chosen_scene
from ..plgs_blender.viewport import load_finding, show_beside, view_of
from . import base


class PLGS_OT_make_masks(base.StartsTask, bpy.types.Operator):
    """Make panoptic masks with a network, of the frames that together see every surface five times. It is downloaded
    only if Blender may go online"""

    bl_idname, bl_label = "plgs.make_masks", "Make Masks"

    model: base.text_argument("Model", "Folder or name of a Mask2Former; empty: the panel's")
    every: base.argument(BoolProperty, "All Frames", "Make masks of all frames, also those that were left out before")

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(MaskMaking):
            return "The engine is already making masks"
        if base.panel_of(context) is None:
            return None
        return base.why_no_folder(context) or why_no_engine() or why_lacking("segment")

    def begin(self, context: bpy.types.Context) -> Task:
        model = self.model or context.scene.plgs_masks.model
        if context.scene.plgs.masks:
            self.report({"WARNING"}, "The panel names other masks. Clear Masks to use the new ones")
        # Blender's own setting is the user's consent to downloads.
        scene = chosen_scene(context.scene.plgs)
        online = bpy.app.online_access
        return preparation.make_masks(scene, usable_python(), model, download=online, every=self.every)


class PLGS_OT_make_depth(base.StartsTask, bpy.types.Operator):
    """Make depth of every photo with a network, fitted to the points of the reconstruction, if the scene has none"""

    bl_idname, bl_label = "plgs.make_depth", "Make Depth"

    model: base.text_argument("Model", "Folder or name of a network for depth; empty: Depth Anything V2 Small")

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(DepthMaking):
            return "The engine is already making depth"
        return base.why_no_folder(context) or why_no_engine() or why_lacking("segment")

    def begin(self, context: bpy.types.Context) -> Task:
        chosen = chosen_scene(context.scene.plgs)
        return preparation.make_depth(chosen, usable_python(), self.model, download=bpy.app.online_access)


class PLGS_OT_import_film(base.ChoosesFile, bpy.types.Operator):
    """Lift a film, or the photos of a folder: find poses, make depth and masks where they are missing, then lift"""

    bl_idname, bl_label = "plgs.import_film", "PLGS Film"

    filepath: base.file_argument("Film", "A film, or a folder of photos")
    filter_glob: base.argument(StringProperty, "Filter", default=";".join(f"*{each}" for each in sorted(FILMS)))

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(FilmMaking):
            return "The engine is already preparing a film"
        return why_no_engine()  # what else it lacks is listed with sizes and licences, before any work

    def ask(self, manager: bpy.types.WindowManager, event: bpy.types.Event) -> set[str]:
        """Open the file browser, unless a film was dropped."""
        return self.execute(bpy.context) if self.filepath else super().ask(manager, event)

    def begin(self, context: bpy.types.Context) -> Task:
        scene, film = context.scene, absolute(self.filepath)
        model, online = scene.plgs_masks.model, bpy.app.online_access
        return preparation.prepare_film(scene.plgs, film, usable_python(), model, download=online)


class PLGS_FH_film(bpy.types.FileHandler):
    """Lifts a film that is dropped on a 3D view"""

    bl_idname, bl_label = "PLGS_FH_film", "PLGS Film"
    bl_import_operator, bl_file_extensions = "plgs.import_film", ";".join(sorted(FILMS))

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


class PLGS_OT_set_scale(base.AsksFirst, bpy.types.Operator):
    """Scale a scene whose lengths have no unit, so that a measured length has its metres"""

    bl_idname, bl_label = "plgs.set_scale", "Set Scale"

    length: base.argument(FloatProperty, "Length Now", "A length in the scene as it is", default=1.0, min=1e-6)
    metres: base.argument(FloatProperty, "Metres", "The same length as measured", default=1.0, min=1e-6)

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return base.why_no_folder(context) or why_no_engine()

    def ask(self, manager: bpy.types.WindowManager, event: bpy.types.Event) -> set[str]:
        return manager.invoke_props_dialog(self)

    def begin(self, context: bpy.types.Context) -> Task:
        return preparation.set_scale(chosen_scene(context.scene.plgs), usable_python(), self.length, self.metres)


class PLGS_OT_measure(bpy.types.Operator):
    """Click two points in the 3D view, then say how far apart they are in the room"""

    bl_idname, bl_label, bl_options = "plgs.measure", "Measure for Scale", {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.points: list[Vector] = []
        self.before = context.scene.cursor.location.copy()
        context.workspace.status_text_set("Click two points whose distance is known; Esc stops")
        context.window_manager.modal_handler_add(self)
        return base.RUNNING

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"}:
            return self._end(context, base.CANCELLED)
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return base.PASSED_ON
        bpy.ops.view3d.cursor3d("INVOKE_DEFAULT", use_depth=True, orientation="NONE")  # finds what is drawn there
        self.points.append(context.scene.cursor.location.copy())
        if len(self.points) < 2:
            return base.RUNNING
        bpy.ops.plgs.set_scale("INVOKE_DEFAULT", length=(self.points[1] - self.points[0]).length)
        return self._end(context, base.FINISHED)

    def _end(self, context: bpy.types.Context, ended: set[str]) -> set[str]:
        context.scene.cursor.location = self.before
        context.workspace.status_text_set(None)
        return ended


class PLGS_OT_make_poses(base.StartsTask, bpy.types.Operator):
    """Find the poses of the scene's photos, or of a video's sharpest frames, with COLMAP, and write them beside it"""

    bl_idname, bl_label = "plgs.make_poses", "Find Poses"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(PoseMaking):
            return "The engine is already finding poses"
        return base.why_no_folder(context) or why_no_engine() or why_lacking("colmap")

    def begin(self, context: bpy.types.Context) -> Task:
        return preparation.make_poses(chosen_scene(context.scene.plgs), usable_python())


class PLGS_OT_read_classes(base.StartsTask, bpy.types.Operator):
    """List the classes of the scene's masks, to name and merge them"""

    bl_idname, bl_label, bl_options = "plgs.read_classes", "Read Classes", {"UNDO"}

    table: base.argument(
        EnumProperty, "Table", "A public table to start from, if the masks' files do not name their classes",
        items=preparation.TABLE_ITEMS, default=preparation.OWN_TABLE,
    )  # fmt: skip

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return base.why_no_folder(context) or why_no_engine()

    def begin(self, context: bpy.types.Context) -> Task:
        return preparation.read_classes(context.scene, self.table)


class PLGS_OT_write_classes(base.StartsTask, bpy.types.Operator):
    """Write the list to classes.toml beside the masks, where every later lift reads it"""

    bl_idname, bl_label = "plgs.write_classes", "Write Classes"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        has_classes = context.scene.plgs.scene_folder and len(context.scene.plgs_masks.classes)
        return why_no_engine() if has_classes else "Read the classes first"

    def begin(self, context: bpy.types.Context) -> Task:
        return preparation.write_classes(context.scene)


_NOTHING = "Nothing was found that can safely be fixed"


class Measures(base.StartsTask):
    """An operator that measures the panel's scene for problems."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(Diagnosis):
            return base.why_no_folder(context) or "A diagnosis is already running"
        # A script waits for the engine's answer; a button is grey until there is one.
        return base.why_no_folder(context) or (None if base.panel_of(context) is None else why_no_engine())


class PLGS_OT_diagnose(Measures, bpy.types.Operator):
    """Check the scene for problems: axes, poses, depth, intrinsics, order, drift, pictures and labels"""

    bl_idname, bl_label, bl_options = "plgs.diagnose", "Diagnose", {"INTERNAL"}

    def begin(self, context: bpy.types.Context) -> Task:
        return diagnose(context.scene.plgs)

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        findings = task.findings if isinstance(task, Diagnosis) else ()
        for finding in findings:
            self.report({"WARNING" if finding.is_wrong else "INFO"}, f"{finding.cause}: {finding.text}")
        return base.FINISHED if findings else super().report_outcome(context, task)


class PLGS_OT_fix_scene(Measures, bpy.types.Operator):
    """Write a copy of the scene with all safe fixes into a new folder, and use it; your files stay as they are"""

    bl_idname, bl_label, bl_options = "plgs.fix_scene", "Fix", {"INTERNAL"}

    folder: base.folder_argument(
        "Folder", "A folder for the fixed scene, which must not exist yet; empty: beside the scene's folder"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        reason = super().why_not(context)
        known = None if reason is not None else diagnosis_of(chosen_scene(context.scene.plgs))
        return reason if known is None or known.can_be_mended else _NOTHING

    def begin(self, context: bpy.types.Context) -> Task:
        settings = context.scene.plgs
        scene = chosen_scene(settings).scene
        return diagnose(settings, absolute(self.folder) if self.folder else free_folder(scene, "mended"))

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        assert isinstance(task, Diagnosis)
        if task.is_running:
            self.report({"INFO"}, f"Writing the fixed copy to {task.mended}")
            return base.FINISHED
        if not task.is_mended:
            self.report({"ERROR"}, _NOTHING if task.error is None else with_field_names(task.error))
            return base.CANCELLED
        self.report({"INFO"}, f"The scene is now the fixed copy: {task.mended}")
        return base.FINISHED


class OnFinding(base.Acts):
    """An operator on one finding about the panel's scene. It does its work at once."""

    number: base.argument(IntProperty, "Number", "Number of the finding, from 0", min=0)

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        known = _known(context)
        return None if known is not None and known.findings else "Diagnose the scene first"

    def finding(self, context: bpy.types.Context) -> tuple[Diagnosis, Finding]:
        """Return the finding that the operator works on. Raises PlgsError if it is gone."""
        known = _known(context)
        if known is None or self.number >= len(known.findings):
            raise PlgsError("no-finding", "there is no such finding", str(self.number), "Diagnose the scene again.")
        return known, known.findings[self.number]


class PLGS_OT_show_finding(OnFinding, bpy.types.Operator):
    """Show the finding's picture in an Image Editor, opened beside the 3D view if there is none"""

    bl_idname, bl_label, bl_options = "plgs.show_finding", "Show Picture", {"INTERNAL", "UNDO"}

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        picture = self.finding(context)[1].picture
        if picture is None:
            self.report({"WARNING"}, "This finding has no picture")
            return base.CANCELLED
        image = load_finding(picture)
        where = "is in the Image Editor" if show_beside(image, context) else "is loaded"
        self.report({"INFO"}, f"{image.name} {where}")
        return base.FINISHED


class PLGS_OT_go_to_finding(OnFinding, bpy.types.Operator):
    """Look through the camera of this frame"""

    bl_idname, bl_label, bl_options = "plgs.go_to_finding", "Go to Frame", {"INTERNAL", "UNDO"}

    frame: base.text_argument("Frame")

    def act(self, context: bpy.types.Context) -> None:
        folder = self.finding(context)[0].chosen.scene
        root = next((each for each in lifts_in(context.scene) if is_same_place(text_of(each, SCENE), folder)), None)
        if root is None:
            fix = "Press Import Cameras and Images first."
            raise PlgsError("no-cameras", "has no cameras in this scene", folder, fix)
        look_from_frame(root, self.frame, context.scene, view_of(context)[0])


class PLGS_OT_leave_out(OnFinding, bpy.types.Operator):
    """Exclude these frames from training and scoring by writing the capture's splits.json. An existing splits.json is
    kept as splits.before.json. To undo this, delete splits.json and rename the kept file"""

    bl_idname, bl_label, bl_options = "plgs.leave_out", "Leave Out", {"INTERNAL"}

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        known, finding = self.finding(context)
        if known.split is None or not known.split.has_any(finding.leave_out):
            self.report({"WARNING"}, "There is no frame to leave out")
            return base.CANCELLED
        path, kept = leave_out(known, finding)
        earlier = "" if kept is None else f". The earlier file is now {kept.name}"
        self.report({"INFO"}, f"Left out {plural(len(finding.leave_out), 'frame')} in {path}{earlier}")
        return base.FINISHED


def _known(context: bpy.types.Context) -> Diagnosis | None:
    """Return the diagnosis of the panel's scene, None if the scene was not measured."""
    settings = context.scene.plgs
    return diagnosis_of(chosen_scene(settings)) if settings.scene_folder else None


PLGS_OT_cancel_depth = base.cancels(DepthMaking, "Stop making depth. Finished maps are kept; the next run continues")
PLGS_OT_cancel_film = base.cancels(FilmMaking, "Stop preparing the film. What is made is kept; the next run continues")
PLGS_OT_cancel_poses = base.cancels(PoseMaking, "Stop finding poses; nothing is written")
PLGS_OT_cancel_masks = base.cancels(MaskMaking, "Stop making masks. Finished ones are kept, and the next run continues")
PLGS_OT_cancel_diagnosis = base.cancels(Diagnosis, "Stop the diagnosis; your files do not change")
