"""Exporting a finished lift, from the panel and from File > Export; its meshes in the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender.inspecting.lookup import active_lift
from ..plgs_blender.lift_collection import FOLDER
from ..plgs_blender.meshes import place_meshes_anew, root_of_placed
from ..plgs_blender.paths import absolute
from ..plgs_blender.running import exports, poll_timer, start
from ..plgs_blender.settings import chosen_lift
from .answers import CANCELLED, FINISHED, PASSED_ON, RUNNING, reporting, reporting_events
from .lift import OnLiftFolder

_FORMS = [(form, label, tells) for form, (label, tells) in exports.FORMS.items()]
_FRAMES = [
    ("all", "All frames", "Every frame; those that are not baked are rendered"),
    ("test", "Held-out frames", "The frames that were held out of training"),
]
_GLANCE_S = 0.25


class Exporting(OnLiftFolder):
    """An operator that lets an engine export a lift."""

    if TYPE_CHECKING:
        poll_message_set: Callable[[str], None]

    frames: EnumProperty(  # type: ignore[valid-type]
        name="Frames", items=_FRAMES, default="all", options={"SKIP_SAVE"}, description="Which frames to export"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = "Wait for the export that is running" if exports.is_running() else start.why_no_engine()
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    def lift_of(self, context: bpy.types.Context) -> str:
        """The folder of the lift that is named, else of the panel's, else of the one that is placed; "" for none."""
        if self.lift_folder or chosen_lift(context.scene.plgs) is not None:
            return str(self.lift_folder)
        root = active_lift(context.scene, context.active_object)
        return str(absolute(root.get(FOLDER, ""))) if root is not None and root.get(FOLDER) else ""


class PLGS_OT_export_lift(Exporting, bpy.types.Operator):
    """Write a finished lift into a folder, in a form that other programs read"""

    bl_idname, bl_label = "plgs.export_lift", "Export"

    form: EnumProperty(name="Form", items=_FORMS, default="coco", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    directory: StringProperty(  # type: ignore[valid-type]
        name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"}, description="Where the files go"
    )
    waits: bool = True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.waits = False
        context.window_manager.fileselect_add(self)
        return RUNNING

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        lift = self.lift_of(context)
        export = start.export_lift(context.scene.plgs, self.form, self.directory, self.frames, lift)
        if self.waits or bpy.app.background:
            exports.wait_for(export)
        else:  # the panel tells how far it is
            poll_timer.begin()
        self.report({"ERROR" if export.error else "INFO"}, export.message)
        return CANCELLED if export.error else FINISHED


class PLGS_OT_make_meshes(Exporting, bpy.types.Operator):
    """Fuse what the lifted model shows into meshes, one for each instance and each stuff class, and put them into the
    scene: for shadows, holdouts, collisions and measuring"""

    bl_idname, bl_label = "plgs.make_meshes", "Make Meshes"
    _export: exports.Export
    _timer: bpy.types.Timer | None = None

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._begin(context)
        poll_timer.begin()
        manager = context.window_manager
        self._timer = manager.event_timer_add(_GLANCE_S, window=context.window or manager.windows[0])
        manager.modal_handler_add(self)
        return RUNNING

    @reporting_events
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type != "TIMER" or not self._export.ended:
            poll_timer.begin()
            return PASSED_ON
        self.cancel(context)
        answer = self._end(context)
        if answer == FINISHED:
            bpy.ops.ed.undo_push(message=self.bl_label)
        return answer

    def cancel(self, context: bpy.types.Context) -> None:
        """Another file was opened, or it is over. The export itself goes on."""
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self._begin(context)
        exports.wait_for(self._export)
        return self._end(context)

    def _begin(self, context: bpy.types.Context) -> None:
        self._lift = start.lift_at(context.scene.plgs, self.lift_of(context)).path
        root_of_placed(self._lift, context.scene)  # hours may pass before the meshes come
        self._scene = context.scene.name
        self._export = start.export_lift(context.scene.plgs, "mesh", "", self.frames, str(self._lift))

    def _end(self, context: bpy.types.Context) -> set[str]:
        if self._export.error or self._export.cancelled:
            self.report({"ERROR" if self._export.error else "INFO"}, self._export.message)
            return CANCELLED
        scene = bpy.data.scenes.get(self._scene)
        if scene is None:
            self.report({"ERROR"}, f"the scene is gone: {self._scene}. Make the meshes again.")
            return CANCELLED
        placed = place_meshes_anew(self._lift, scene)
        self.report({"INFO"}, f"{len(placed)} meshes are in the scene")
        return FINISHED


class PLGS_OT_cancel_export(bpy.types.Operator):
    """Stop the export; what was written so far stays"""

    bl_idname, bl_label = "plgs.cancel_export", "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No export is running")
        return exports.is_running()

    def execute(self, context: bpy.types.Context) -> set[str]:
        export = exports.latest()
        if export is not None and not export.ended:
            export.cancel()
        return FINISHED


CLASSES = (PLGS_OT_export_lift, PLGS_OT_make_meshes, PLGS_OT_cancel_export)
