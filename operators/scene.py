"""Frames into Blender, before anything is lifted."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..plgs_blender.dropping import lift_or_scene
from ..plgs_blender.import_scene import place_scene
from ..plgs_blender.paths import absolute
from ..plgs_blender.running import poll_timer, start
from ..plgs_blender.settings import place_of
from .answers import FINISHED, panel_of, reporting


class PLGS_OT_import_scene(bpy.types.Operator):
    """Put a camera with its picture into the scene for each frame; nothing is lifted"""

    bl_idname, bl_label, bl_options = "plgs.import_scene", "Import Cameras and Images", {"UNDO"}

    scene_folder: StringProperty(  # type: ignore[valid-type]
        name="Scene", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="The scene's folder; empty: the one of the panel",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        panel = panel_of(context)
        reason = None if panel is None else start.why_no_scene(panel)
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.plgs
        if self.scene_folder:
            settings.scene_folder = self.scene_folder
        place = place_of(settings)
        root = place_scene(place.folder, context.scene, masks=place.masks, up=place.up)
        self.report({"INFO"}, f"{root.name}: {len(root.all_objects)} cameras")
        return FINISHED


class PLGS_OT_look_at_scene(bpy.types.Operator):
    """Look anew at what is in the scene's folder"""

    bl_idname, bl_label, bl_options = "plgs.look_at_scene", "Look Again", {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Choose the scene's folder first")
        return bool(context.scene.plgs.scene_folder)

    def execute(self, context: bpy.types.Context) -> set[str]:
        poll_timer.look_at_scene(place_of(context.scene.plgs))
        return FINISHED


class PLGS_OT_open_dropped(bpy.types.Operator):
    """Open the scene or the lift that a file belongs to"""

    bl_idname, bl_label, bl_options = "plgs.open_dropped", "Open in PLGS", {"UNDO"}

    filepath: StringProperty(  # type: ignore[valid-type]
        name="File", subtype="FILE_PATH", options={"SKIP_SAVE"},
        description="Any file out of a scene's or a lift's folder, or the folder itself",
    )  # fmt: skip

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        lift, scene = lift_or_scene(Path(absolute(self.filepath)))
        settings = context.scene.plgs
        if lift is not None:
            settings.lift_folder = str(lift)
        else:
            settings.scene_folder = str(scene)
        self.report({"INFO"}, f"PLGS: {lift or scene}")
        return FINISHED


class PLGS_FH_scene(bpy.types.FileHandler):
    """A panoptic.json, request.json, pose or intrinsic file dropped on a 3D view opens what it is part of"""

    bl_idname, bl_label = "PLGS_FH_scene", "PLGS scene or lift"
    bl_import_operator, bl_file_extensions = "plgs.open_dropped", ".json;.txt;.jsonl"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


CLASSES = (PLGS_OT_import_scene, PLGS_OT_look_at_scene, PLGS_OT_open_dropped, PLGS_FH_scene)
