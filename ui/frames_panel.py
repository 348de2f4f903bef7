"""Below 1 Scene: what is shown before the active camera's view, and how far an engine is with the frames."""

from __future__ import annotations

import bpy

from ..plgs_blender.frame_pictures import DEPTH, MASKS, range_shown, why_no_picture
from ..plgs_blender.frames import PHOTO, SHOWN
from ..plgs_blender.owned import LIFT
from ..plgs_blender.running import frame_making
from ..plgs_blender.settings import place_of
from .sidebar import Sidebar, tell

_BUTTONS = ((PHOTO, "Photo", "IMAGE_DATA"), (DEPTH, "Depth", "EMPTY_SINGLE_ARROW"), (MASKS, "Masks", "COLOR"))


class PLGS_PT_frames(Sidebar, bpy.types.Panel):
    bl_idname, bl_label, bl_parent_id = "PLGS_PT_frames", "Frames", "PLGS_PT_scene"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        is_ours = why_no_picture(context.scene) is None
        return is_ours or frame_making.is_making() or _problem(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout, ob = self.layout, context.scene.camera
        if frame_making.is_making():
            row = layout.row(align=True)
            done, total = frame_making.progress() or (0, 0)
            text = f"Frames {done} of {total}" if total else "Engine starts ..."
            row.progress(factor=done / total if total else 0.0, text=text)
            row.operator("plgs.cancel_frames", text="", icon="X")
        problem = _problem(context)
        if problem is not None:
            tell(layout, context, problem, "ERROR")
        if why_no_picture(context.scene) is not None:
            return
        row = layout.row(align=True)
        for what, label, icon in _BUTTONS:
            button = row.operator(
                "plgs.show_picture", text=label, icon=icon, depress=ob.get(SHOWN, PHOTO) == what
            )  # fmt: skip
            button.what = what
        span = range_shown(ob)
        if span is not None:
            layout.label(text=f"{span[0]:.2f} m (light) to {span[1]:.2f} m (dark)", icon="BLANK1")


def _problem(context: bpy.types.Context) -> str | None:
    """Why the engine failed, for the panel's scene or that of the active camera."""
    settings, ob = context.scene.plgs, context.scene.camera
    place = place_of(settings) if settings.scene_folder else None
    return frame_making.error_for(place, "" if ob is None else ob.get(LIFT, ""))


CLASSES = (PLGS_PT_frames,)
