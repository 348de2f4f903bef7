"""Operators that import frames into Blender before a lift: cameras, pictures and coloured points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..plgs_blender import registry
from ..plgs_blender.cameras import PHOTO
from ..plgs_blender.chosen_scene import AUTOMATIC, FILE_SUFFIXES, absolute, lift_or_scene, scene_at
from ..plgs_blender.errors import one_line, plural, with_field_names
from ..plgs_blender.frame_pictures import DEPTH, MASKS, range_shown, why_no_picture
from ..plgs_blender.registry import Task
from ..plgs_blender.running.importing import FrameMaking, begin_import, choose_picture, imported, what_is_missing
from ..plgs_blender.running.lifting import why_no_scene
from ..plgs_blender.running.looking import look_at_scene
from ..plgs_blender.sample import own_sample
from ..plgs_blender.settings import SceneOptions, chosen_scene
from ..plgs_blender.viewport import look_through, show_materials_in
from . import base

_PICTURES = [
    (PHOTO, "Photo", "What the frame's camera saw, half transparent"),
    (DEPTH, "Depth", "Distance to the surfaces: light is near, dark is far, with a line at each whole metre"),
    (MASKS, "Masks", "The frame's panoptic mask in its classes' colours"),
]


class ImportsScene(SceneOptions, base.StartsTask):
    """An operator that imports a scene, perhaps with an engine. Options that are not given are the panel's."""

    cloud: base.argument(BoolProperty, "Coloured Cloud", "Make a coloured cloud of the scene's depth", default=True)

    def begin(self, context: bpy.types.Context) -> Task | None:
        return begin_import(context.scene, cloud=self.cloud)

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        root = imported(context.scene)
        is_making = task is not None and task.is_running
        error = None if task is None else task.error
        if root is None:
            if error is not None:
                raise error
            self.report({"INFO"}, "An engine is reading the scene: its cameras appear when it is done")
            return base.FINISHED if is_making else base.CANCELLED
        cameras = plural(sum("frame" in ob for ob in root.all_objects), "camera")
        lacking = "" if is_making else what_is_missing(root) if error is None else with_field_names(error)
        show_materials_in(context.scene)
        self.report({"WARNING" if lacking else "INFO"}, f"{one_line(root.name)}: {cameras}. {lacking}".rstrip())
        return base.FINISHED


def _forget_other_scene(settings: Any) -> None:
    """Clear the masks, detections, depth, up axis and format of the earlier scene before another one is chosen."""
    settings.scene_folder = ""  # otherwise each change would look at the earlier scene
    settings.masks, settings.detections, settings.depth = "", "", ""
    settings.up, settings.format = "z", AUTOMATIC


class PLGS_OT_import_scene(ImportsScene, bpy.types.Operator):
    """Add a camera with its picture for each frame, and coloured points, without lifting"""

    bl_idname, bl_label, bl_options = "plgs.import_scene", "Import Cameras and Images", {"UNDO"}

    scene_folder: base.folder_argument("Scene", "The scene's folder or file; empty: the panel's")

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        panel = base.panel_of(context)
        return None if panel is None else why_no_scene(panel)

    def begin(self, context: bpy.types.Context) -> Task | None:
        settings = context.scene.plgs
        base.copy_given(self, SceneOptions, settings)
        if self.scene_folder:
            settings.scene_folder = self.scene_folder
        return super().begin(context)


class PLGS_OT_browse_scene(ImportsScene, base.ChoosesFile, bpy.types.Operator):
    """Import the cameras and images of posed frames: a folder, or a file such as transforms.json, .sens or .r3d"""

    bl_idname, bl_label, bl_options = "plgs.browse_scene", "PLGS Scene", {"UNDO", "PRESET"}

    filepath: base.file_argument("File", "The scene's file, any file in its folder, or the folder itself")
    filter_glob: StringProperty(default=";".join(f"*{each}" for each in FILE_SUFFIXES), options={"HIDDEN", "SKIP_SAVE"})

    def begin(self, context: bpy.types.Context) -> Task | None:
        settings = context.scene.plgs
        scene = scene_at(Path(absolute(self.filepath)))
        _forget_other_scene(settings)
        base.copy_given(self, SceneOptions, settings)
        settings.scene_folder = str(scene)
        return super().begin(context)


class PLGS_OT_try_sample(ImportsScene, bpy.types.Operator):
    """Copy a small room into your home folder, and import it: try PLGS without a capture of your own"""

    bl_idname, bl_label, bl_options = "plgs.try_sample", "Try the Sample", {"UNDO"}

    def begin(self, context: bpy.types.Context) -> Task | None:
        _forget_other_scene(context.scene.plgs)
        context.scene.plgs.scene_folder = str(own_sample())
        return super().begin(context)


class PLGS_OT_show_picture(base.StartsTask, bpy.types.Operator):
    """Show the photo, depth or masks in front of the frames' cameras"""

    bl_idname, bl_label, bl_options = "plgs.show_picture", "Show Picture", {"UNDO"}

    what: base.argument(EnumProperty, "What", "Which picture", items=_PICTURES, default=DEPTH)

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return next(text for name, _, text in _PICTURES if name == properties.what)

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        # Grey while an engine makes the picture, the pressed button would stay grey: Blender keeps how a button under
        # the mouse looked.
        return why_no_picture(context.scene)

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        view = context.space_data
        if isinstance(view, bpy.types.SpaceView3D) and not view.use_local_camera:
            look_through(view, context.scene)
        return self.run(context, waits=bpy.app.background)

    def begin(self, context: bpy.types.Context) -> Task | None:
        registry.refuse_second(FrameMaking)
        return choose_picture(context.scene, self.what)

    def report_outcome(self, context: bpy.types.Context, task: Task | None) -> set[str]:
        span = range_shown(context.scene.camera)
        if (task is None or task.has_finished) and span is not None:
            self.report({"INFO"}, f"Depth from {span[0]:.2f} to {span[1]:.2f} m, with a line at each whole metre")
        return super().report_outcome(context, task)


class PLGS_OT_look_at_scene(base.Acts, bpy.types.Operator):
    """Read the scene's folder again"""

    bl_idname, bl_label, bl_options = "plgs.look_at_scene", "Look Again", {"INTERNAL"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return base.why_no_folder(context)

    def act(self, context: bpy.types.Context) -> None:
        look_at_scene(chosen_scene(context.scene.plgs))


class PLGS_OT_open_dropped(base.Acts, bpy.types.Operator):
    """Open the scene or the lift that a file belongs to"""

    bl_idname, bl_label, bl_options = "plgs.open_dropped", "Open in PLGS", {"UNDO"}

    filepath: base.file_argument("File", "Any file in a scene's or a lift's folder, or the folder itself")

    def act(self, context: bpy.types.Context) -> str:
        lift, scene = lift_or_scene(Path(absolute(self.filepath)))
        settings = context.scene.plgs
        if lift is not None:
            settings.lift_folder = str(lift)
        else:
            if not settings.scene_folder or absolute(settings.scene_folder) != scene:
                _forget_other_scene(settings)
            settings.scene_folder = str(scene)
        return f"Opened {lift or scene}"


class PLGS_FH_scene(bpy.types.FileHandler):
    """Opens the scene or the lift that a file dropped on a 3D view belongs to"""

    bl_idname, bl_label = "PLGS_FH_scene", "PLGS Scene or Lift"
    bl_import_operator, bl_file_extensions = "plgs.open_dropped", ";".join(FILE_SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


PLGS_OT_cancel_frames = base.cancels(FrameMaking, "Stop making pictures and the cloud. Importing again continues")
