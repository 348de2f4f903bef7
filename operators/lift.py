"""Operators that start, watch, stop, resume, show and export a lift, and make its meshes."""

from __future__ import annotations

import textwrap
import time

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..plgs_blender import shown_export
from ..plgs_blender.chosen_scene import absolute, free_folder
from ..plgs_blender.engine_environment import why_no_engine
from ..plgs_blender.errors import one_line, plural
from ..plgs_blender.inspecting.looks import SURFACE, has
from ..plgs_blender.inspecting.selection import active_lift, find_lift
from ..plgs_blender.meshes import are_stale
from ..plgs_blender.owned import FOLDER, folder_of
from ..plgs_blender.registry import Task
from ..plgs_blender.running import exports, lifting, lifts
from ..plgs_blender.running.adding import CAPABILITIES, why_lacking
from ..plgs_blender.settings import LiftOptions, chosen_lift
from . import base

_PART_S = 0.02  # seconds to pause between the parts of a lift that is being placed


class PLGS_OT_lift_scene(LiftOptions, base.StartsTask, bpy.types.Operator):
    """Start a lift of the scene in the background. Options that you do not set are taken from the panel"""

    bl_idname, bl_label = "plgs.lift_scene", "Start"
    has_undo_step = True

    names_from: base.folder_argument(
        "Names From", "An earlier lift whose names are kept; empty: the one in this scene, if Keep Names is on"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        panel = base.panel_of(context)
        return why_no_engine() if panel is None else lifting.why_no_lift(panel)

    def begin(self, context: bpy.types.Context) -> Task:
        settings = context.scene.plgs
        base.copy_given(self, LiftOptions, settings)
        in_that_folder = self.properties.is_property_set("lift_folder")
        return lifting.start_lift(settings, in_that_folder=in_that_folder, names_from=self.names_from)


class PLGS_OT_resume_lift(base.OnLiftFolder, base.StartsTask, bpy.types.Operator):
    """Continue a lift that was cancelled or interrupted"""

    bl_idname, bl_label = "plgs.resume_lift", "Resume"
    has_undo_step = True

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.resume_lift(context.scene.plgs, self.lift_folder)


class PLGS_OT_refine_lift(base.OnLiftFolder, base.StartsTask, bpy.types.Operator):
    """Go on from a finished draft by the panel's preset, or by Preview. Names and corrections stay"""

    bl_idname, bl_label = "plgs.refine_lift", "Refine"
    has_undo_step = True

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.refine_lift(context.scene.plgs, self.lift_folder)


class PLGS_OT_find_scene(base.OnLiftFolder, base.ChoosesFile, bpy.types.Operator):
    """Choose where the scene of a lift was moved to. The frames there are compared with those of the lift"""

    bl_idname, bl_label, bl_options = "plgs.find_scene", "Find Scene", {"UNDO"}

    filepath: base.file_argument("Scene", "The scene's folder, or its one file")

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return why_no_engine()

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.find_scene(context.scene, absolute(self.filepath), self.lift_folder)


class PLGS_OT_watch_lift(base.OnLiftFolder, base.StartsTask, bpy.types.Operator):
    """Follow a lift that another Blender or a command started, or look at one that has ended"""

    bl_idname, bl_label = "plgs.watch_lift", "Watch"
    has_undo_step = True

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.join_lift(context.scene, self.lift_folder)


class PLGS_OT_open_lift(base.ChoosesFile, bpy.types.Operator):
    """Choose a lift's folder. A finished lift is put into the scene, and a running one is followed"""

    bl_idname, bl_label = "plgs.open_lift", "Open Lift"
    has_undo_step = True

    directory: base.folder_argument("Lift Folder", "The folder of a lift")

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.join_lift(context.scene, str(absolute(self.directory)))

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run(context, waits=bpy.app.background)


class PLGS_OT_find_lift(base.Acts, bpy.types.Operator):
    """Choose where the lift that is shown was moved to. Its objects in the scene stay as they are"""

    bl_idname, bl_label, bl_options = "plgs.find_lift", "Find Lift", {"UNDO"}

    directory: base.folder_argument("Lift Folder", "The folder of the lift")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return base.RUNNING

    def act(self, context: bpy.types.Context) -> str:
        return lifting.bind_lift(context.scene, context.active_object, absolute(self.directory))


class PLGS_OT_cancel_lift(base.OnLiftFolder, base.Acts, bpy.types.Operator):
    """Stop the lift at its next step, within a second; it can be resumed"""

    bl_idname, bl_label = "plgs.cancel_lift", "Cancel"

    def act(self, context: bpy.types.Context) -> None:
        lifting.cancel_lift(context.scene.plgs, self.lift_folder)


class PLGS_OT_quit(bpy.types.Operator):
    """Quit Blender, which stops the running lift: it can be resumed later"""

    bl_idname, bl_label = "plgs.quit", "Quit Blender"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return lifts.stops_with_blender(context.scene)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        ask = context.window_manager.invoke_confirm
        return set(ask(self, event, title=self.bl_label, message=self.__doc__ or "", confirm_text="Quit"))

    def execute(self, context: bpy.types.Context) -> set[str]:
        return set(bpy.ops.wm.quit_blender("INVOKE_DEFAULT"))  # which asks about unsaved changes


class PLGS_OT_refresh_lifts(base.Acts, bpy.types.Operator):
    """Update the list of running and finished lifts, including those of other Blenders"""

    bl_idname, bl_label, bl_options = "plgs.refresh_lifts", "Look Again", {"INTERNAL"}

    def act(self, context: bpy.types.Context) -> None:
        lifts.refresh_recent()


class PLGS_OT_place_lift(base.OnLiftFolder, bpy.types.Operator):
    """Put a finished lift into the scene: cameras, points, anchors, boxes and passes"""

    bl_idname, bl_label, bl_options = "plgs.place_lift", "Show Result", {"UNDO"}

    _at_work = False
    """Whether a timer is placing a lift part by part: the parts of a second one would mix with it."""

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self._placing = lifting.showing_lift(context.scene, self.lift_folder)
        while self.has_more():
            pass
        return base.FINISHED

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Place the first part at once and the rest on a timer, so that the window never freezes."""
        if bpy.app.background:
            return self.execute(context)
        if PLGS_OT_place_lift._at_work:
            self.report({"INFO"}, "A lift is being placed. Wait a moment")
            return base.CANCELLED
        self._placing = lifting.showing_lift(context.scene, self.lift_folder)
        self.has_more()
        self._timer = base.start_timer(self, context, _PART_S)
        PLGS_OT_place_lift._at_work = True
        return base.RUNNING

    @base.reporting
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type != "TIMER":
            return base.PASSED_ON
        goes_on = False
        try:
            goes_on = self.has_more()
        finally:
            if not goes_on:
                self.cancel(context)
        return base.PASSED_ON if goes_on else base.FINISHED

    def has_more(self) -> bool:
        """Place as many parts as fit in an unnoticeable pause. Returns whether there may be more."""
        began = time.monotonic()
        try:
            while time.monotonic() - began < _PART_S:
                next(self._placing)
        except StopIteration as end:
            found = end.value.find() if end.value is not None else None
            message = f"{one_line(found[0].name)} was placed" if found is not None else "The lift was removed meanwhile"
            self.report({"INFO"}, message)
            return False
        return True

    def cancel(self, context: bpy.types.Context) -> None:
        """Remove the timer. Blender also calls this when another file is opened."""
        PLGS_OT_place_lift._at_work = False
        context.window_manager.event_timer_remove(self._timer)


class PLGS_OT_open_log(base.OnLiftFolder, base.Acts, bpy.types.Operator):
    """Open the engine's log in the system's text editor"""

    bl_idname, bl_label, bl_options = "plgs.open_log", "Open Log", {"INTERNAL"}

    def act(self, context: bpy.types.Context) -> None:
        bpy.ops.wm.path_open(filepath=str(lifting.log_of(context.scene.plgs, self.lift_folder)))


_FORMS = [(form, label, about) for form, (label, about) in exports.FORMS.items()]
_FRAMES = [
    ("all", "All Frames", "Every frame; those that are not baked are rendered"),
    ("test", "Check Frames", "The held-out frames, which the lift did not learn from"),
]


class OfShownLift(base.OnLiftFolder):
    """An operator on the lift that the panels show, unless its folder is given."""

    def lift_of(self, context: bpy.types.Context) -> str:
        """Return the folder of the named lift, else of the panel's lift, else of the placed one, else ""."""
        if self.lift_folder or chosen_lift(context.scene.plgs) is not None:
            return str(self.lift_folder)
        root = active_lift(context.scene, context.active_object)
        return str(absolute(root.get(FOLDER, ""))) if root is not None and root.get(FOLDER) else ""


class Exports(OfShownLift, base.StartsTask):
    """An operator that exports a lift as a task."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return "An export is already running" if exports.is_busy() else why_no_engine()


class ExportsFrames(Exports):
    """An operator that exports a lift as some of its frames see it."""

    frames: base.argument(EnumProperty, "Frames", "Which frames to export", items=_FRAMES, default="all")


class PLGS_OT_export_lift(ExportsFrames, base.ChoosesFile, bpy.types.Operator):
    """Write a finished lift to a folder, in a format that other programs read"""

    bl_idname, bl_label = "plgs.export_lift", "Export"

    form: base.argument(EnumProperty, "Format", items=_FORMS, default="gltf")
    directory: base.folder_argument("Folder", "Where the files go")
    filepath: base.argument(StringProperty, "Folder", "The folder that a file browser names", subtype="FILE_PATH")

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return exports.FORMS[properties.form][1]

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Report what is lacking, or propose a new folder beside the lift and open the file browser."""
        lacking = why_lacking(self.form) if self.form in CAPABILITIES else None
        if lacking is not None:
            self.report({"ERROR"}, lacking)
            return base.CANCELLED
        lift = lifting.lift_at(context.scene.plgs, self.lift_of(context))
        self.filepath = str(free_folder(exports.beside(lift.path), self.form))
        return super().invoke(context, event)

    def draw(self, context: bpy.types.Context) -> None:
        if self.form in exports.OF_FRAMES:
            self.layout.prop(self, "frames")
        for line in textwrap.wrap(exports.FORMS[self.form][1], 36):
            self.layout.label(text=line)

    def begin(self, context: bpy.types.Context) -> Task:
        output = self.filepath if self.was_invoked else self.directory
        return lifting.export_lift(context.scene.plgs, self.form, output, self.frames, self.lift_of(context))


class PLGS_OT_export_shown(OfShownLift, base.Acts, bpy.types.Operator):
    """Write the meshes that are shown, with their names and pictures, in seconds"""

    bl_idname, bl_label = "plgs.export_shown", "Export What Is Shown"

    form: base.argument(EnumProperty, "Format", items=[("gltf", "glTF", "One GLB"), ("usd", "OpenUSD", "One USDZ")])
    filepath: base.file_argument("File", "Its ending chooses the kind: .glb or .gltf; .usdz, .usdc, .usda or .usd")
    check_existing: base.argument(BoolProperty, "Check Existing", "Ask before overwriting", default=True)

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        root = active_lift(context.scene, context.active_object)
        return None if root is not None and has(root, SURFACE) else "There are no meshes yet: press Surface in 3 Result"

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        lacking = shown_export.why_not(self.form)
        if lacking is not None:
            self.report({"ERROR"}, lacking)
            return base.CANCELLED
        root = find_lift(context.scene, self.lift_folder, context.active_object)
        self.filepath = f"{exports.beside(folder_of(root))}{shown_export.SUFFIXES[self.form][0]}"
        context.window_manager.fileselect_add(self)
        return base.RUNNING

    def draw(self, context: bpy.types.Context) -> None:
        pass  # its options are the file's name

    def act(self, context: bpy.types.Context) -> str:
        root = find_lift(context.scene, self.lift_folder, context.active_object)
        count = shown_export.export_shown(root, context.scene, self.form, absolute(self.filepath))
        return f"{plural(count, 'mesh is', 'meshes are')} in {self.filepath}"


class PLGS_OT_make_meshes(ExportsFrames, bpy.types.Operator):
    """Make one mesh for each instance and each stuff class from the lifted model, and put them into the scene, for
    shadows, holdouts, collisions and measuring"""

    bl_idname, bl_label = "plgs.make_meshes", "Make Meshes"

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        root = active_lift(context.scene, context.active_object)
        is_old = root is not None and has(root, SURFACE) and are_stale(root)
        return "Make the surface again: it is older than the last corrections" if is_old else ""

    def begin(self, context: bpy.types.Context) -> Task:
        lift = lifting.lift_at(context.scene.plgs, self.lift_of(context))
        return exports.make_meshes(lift.path, context.scene, self.frames)


class PLGS_OT_make_depth_cloud(Exports, bpy.types.Operator):
    """Add what the active camera sees of the lift as points, one per pixel, with class and instance"""

    bl_idname, bl_label = "plgs.make_depth_cloud", "Depth Cloud"

    frame: base.text_argument("Frame", "Empty: what the active camera sees")

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.make_depth_cloud(context.scene, self.frame, self.lift_of(context))


PLGS_OT_cancel_export = base.cancels(exports.Export, "Stop the export; files that are already written stay")
