"""Exporting a finished lift, from the panel and from File > Export; its meshes in the scene."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender.engine_environment import why_no_engine
from ..plgs_blender.inspecting.looks import SURFACE, has
from ..plgs_blender.inspecting.lookup import active_lift
from ..plgs_blender.lift_collection import FOLDER
from ..plgs_blender.meshes import are_stale
from ..plgs_blender.paths import absolute
from ..plgs_blender.running import exports, lifting
from ..plgs_blender.settings import chosen_lift
from ..plgs_blender.tasks.registry import Task
from .base import RUNNING, CancelsTask, OnLiftFolder, StartsTask, reporting

_FORMS = [(form, label, about) for form, (label, about) in exports.FORMS.items()]
_FRAMES = [
    ("all", "All Frames", "Every frame; those that are not baked are rendered"),
    ("test", "Held-Out Frames", "The frames that were held out of training"),
]


class Exports(OnLiftFolder, StartsTask):
    """An operator that lets an engine export a lift."""

    frames: EnumProperty(  # type: ignore[valid-type]
        name="Frames", items=_FRAMES, default="all", options={"SKIP_SAVE"}, description="Which frames to export"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        return "Wait for the export that is running" if exports.is_busy() else why_no_engine()

    def lift_of(self, context: bpy.types.Context) -> str:
        """The folder of the named lift, else of the panel's lift, else of the placed one; "" for none."""
        if self.lift_folder or chosen_lift(context.scene.plgs) is not None:
            return str(self.lift_folder)
        root = active_lift(context.scene, context.active_object)
        return str(absolute(root.get(FOLDER, ""))) if root is not None and root.get(FOLDER) else ""


class PLGS_OT_export_lift(Exports, bpy.types.Operator):
    """Write a finished lift to a folder, in a format that other programs can read"""

    bl_idname, bl_label = "plgs.export_lift", "Export"

    form: EnumProperty(name="Format", items=_FORMS, default="coco", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    directory: StringProperty(  # type: ignore[valid-type]
        name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"}, description="Where the files go"
    )
    was_invoked = False

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.was_invoked = True
        context.window_manager.fileselect_add(self)
        return RUNNING

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run(context, waits=not self.was_invoked)

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.export_lift(
            context.scene.plgs, self.form, self.directory, self.frames, self.lift_of(context)
        )  # fmt: skip


class PLGS_OT_make_meshes(Exports, bpy.types.Operator):
    """Make meshes of what the lifted model shows, one for each instance and each stuff class, and put them into the
    scene, for shadows, holdouts, collisions and measuring"""

    bl_idname, bl_label = "plgs.make_meshes", "Make Meshes"

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        root = active_lift(context.scene, context.active_object)
        is_old = root is not None and has(root, SURFACE) and are_stale(root)
        return "Make the surface again: it shows the state before the last corrections" if is_old else ""

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.make_meshes(context.scene, self.frames, self.lift_of(context))


class PLGS_OT_make_depth_cloud(Exports, bpy.types.Operator):
    """Put what the active camera sees of the lift into the scene as points, one per pixel, with class and instance"""

    bl_idname, bl_label = "plgs.make_depth_cloud", "Depth Cloud"

    frame: StringProperty(name="Frame", options={"SKIP_SAVE"}, description="Empty: what the active camera sees")  # type: ignore[valid-type]

    def begin(self, context: bpy.types.Context) -> Task:
        return lifting.make_depth_cloud(context.scene, self.frame, self.lift_of(context))


class PLGS_OT_cancel_export(CancelsTask, bpy.types.Operator):
    """Stop the export; files that are already written stay"""

    bl_idname, bl_label = "plgs.cancel_export", "Cancel"
    cancelled_kind = exports.Export


CLASSES = (PLGS_OT_export_lift, PLGS_OT_make_meshes, PLGS_OT_make_depth_cloud, PLGS_OT_cancel_export)
