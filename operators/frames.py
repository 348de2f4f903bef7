"""A frame's photo, depth or masks before its camera's view, and the engine that makes what Blender cannot."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty

from ..plgs_blender.frame_pictures import DEPTH, MASKS, range_shown, why_no_picture
from ..plgs_blender.frames import PHOTO
from ..plgs_blender.running import frame_making, poll_timer
from ..plgs_blender.running.importing import show_picture
from .answers import CANCELLED, FINISHED, reporting, reporting_events

_WHAT = [
    (PHOTO, "Photo", "What the frame's camera saw, half transparent"),
    (DEPTH, "Depth", "How far surfaces are: light is near, dark is far, a line at each whole metre"),
    (MASKS, "Masks", "The frame's panoptic mask in its classes' colours"),
]


class PLGS_OT_show_picture(bpy.types.Operator):
    """Show the photo, the depth or the masks of the active camera's frame before what it sees"""

    bl_idname, bl_label, bl_options = "plgs.show_picture", "Show Picture", {"UNDO"}

    what: EnumProperty(  # type: ignore[valid-type]
        name="What", items=_WHAT, default=DEPTH, options={"SKIP_SAVE"}, description="Which picture"
    )
    waits = True

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return next(text for name, _, text in _WHAT if name == properties.what)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = why_no_picture(context.scene)
        if reason is None and frame_making.is_making():
            reason = "An engine makes frames just now: wait until it is done, or cancel it"
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.waits = False
        view = context.space_data
        if isinstance(view, bpy.types.SpaceView3D) and not view.use_local_camera:
            view.region_3d.view_perspective = "CAMERA"
        return self.execute(context)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        if not show_picture(context.scene, self.what):
            if not self.waits:
                poll_timer.begin()
                return FINISHED
            frame_making.wait()
            if frame_making.error() is not None:
                self.report({"ERROR"}, str(frame_making.error()))
                return CANCELLED
        span = range_shown(context.scene.camera)
        if span is not None:
            self.report({"INFO"}, f"Depth from {span[0]:.2f} to {span[1]:.2f} m, a line at each whole metre")
        return FINISHED


class PLGS_OT_cancel_frames(bpy.types.Operator):
    """Stop making pictures and the cloud. What is made already is kept: importing again goes on"""

    bl_idname, bl_label, bl_options = "plgs.cancel_frames", "Cancel", {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not frame_making.is_making():
            cls.poll_message_set("No frames are being made")
        return frame_making.is_making()

    def execute(self, context: bpy.types.Context) -> set[str]:
        frame_making.stop()
        return FINISHED


CLASSES = (PLGS_OT_show_picture, PLGS_OT_cancel_frames)
