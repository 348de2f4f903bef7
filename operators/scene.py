"""Frames into Blender, before anything is lifted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..plgs_blender.dropping import lift_or_scene, scene_at
from ..plgs_blender.paths import absolute
from ..plgs_blender.running import frame_making, poll_timer, start
from ..plgs_blender.running.importing import begin_import, imported, what_is_missing
from ..plgs_blender.scene_formats import AUTOMATIC, FILE_SUFFIXES, FORMAT_ITEMS, MASK_FORMAT_ITEMS, chosen_format
from ..plgs_blender.settings import UPS, place_of
from ..plgs_blender.viewport import show_lift_colours_at_first
from .answers import CANCELLED, FINISHED, RUNNING, panel_of, reporting, reporting_events


class SceneOptions:
    """How a scene is read, for operators: what is not given is as in the panel."""

    format: EnumProperty(  # type: ignore[valid-type]
        name="Format", items=FORMAT_ITEMS, default=AUTOMATIC, options={"SKIP_SAVE"},
        description="How the scene is laid out, where its looks do not tell",
    )  # fmt: skip
    masks: StringProperty(  # type: ignore[valid-type]
        name="Masks", subtype="FILE_PATH", options={"SKIP_SAVE"},
        description="Panoptic masks that lie elsewhere than in the scene's folder",
    )  # fmt: skip
    mask_format: EnumProperty(  # type: ignore[valid-type]
        name="Mask format", items=MASK_FORMAT_ITEMS, default=AUTOMATIC, options={"SKIP_SAVE"},
        description="How the masks are laid out, where their looks do not tell",
    )  # fmt: skip
    classes_table: StringProperty(  # type: ignore[valid-type]
        name="Classes", options={"SKIP_SAVE"}, description="The masks' classes: a .toml file, or a table's name"
    )
    depth: StringProperty(  # type: ignore[valid-type]
        name="Depth maps", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="Folder of a network's depth maps, one a frame",
    )  # fmt: skip
    up: EnumProperty(  # type: ignore[valid-type]
        name="Up", items=UPS, default="z", options={"SKIP_SAVE"}, description="The axis of the poses that points up"
    )
    cloud: BoolProperty(  # type: ignore[valid-type]
        name="Coloured Cloud", default=True, options={"SKIP_SAVE"},
        description="Let an engine make a coloured cloud of the scene's depth",
    )  # fmt: skip

    report: Callable[[set[str], str], None]
    properties: Any

    def into_settings(self, settings: Any) -> None:
        """Let the panel say what was given."""
        for name in ("format", "masks", "mask_format", "classes_table", "depth", "up"):
            if self.properties.is_property_set(name):
                setattr(settings, name, getattr(self, name))

    waits = True
    """For the engine: a script does, a button does not."""

    def import_it(self, context: bpy.types.Context) -> set[str]:
        """Import the scene of the panel, with an engine for what Blender cannot make of it."""
        begin_import(context.scene, cloud=self.cloud)
        if self.waits:
            frame_making.wait()
        else:
            poll_timer.begin()
        root = imported(context.scene)
        if root is None and self.waits:
            self.report({"ERROR"}, str(frame_making.error()))
            return CANCELLED
        if root is None:
            self.report({"INFO"}, "An engine reads the scene: its cameras come when it is done")
            return FINISHED
        cameras = sum("frame" in ob for ob in root.all_objects)
        lacking = "" if frame_making.is_making() else frame_making.error() or what_is_missing(root)
        view = context.space_data
        if isinstance(view, bpy.types.SpaceView3D):
            show_lift_colours_at_first(view)
        self.report({"WARNING" if lacking else "INFO"}, f"{root.name}: {cameras} cameras. {lacking}".rstrip())
        return FINISHED


def _forget_other_scene(settings: Any) -> None:
    """Before a scene is chosen: what the panel says of masks, depth, up and format is the earlier one's."""
    settings.scene_folder = ""  # so that the earlier one is not looked at with each change
    settings.masks, settings.depth, settings.up, settings.format = "", "", "z", AUTOMATIC


class PLGS_OT_import_scene(SceneOptions, bpy.types.Operator):
    """Put a camera with its picture into the scene for each frame, and coloured points; nothing is lifted"""

    bl_idname, bl_label, bl_options = "plgs.import_scene", "Import Cameras and Images", {"UNDO"}

    scene_folder: StringProperty(  # type: ignore[valid-type]
        name="Scene", subtype="DIR_PATH", options={"SKIP_SAVE"},
        description="The scene's folder or file; empty: the one of the panel",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        panel = panel_of(context)
        reason = None if panel is None else start.why_no_scene(panel)
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.waits = False
        return self.execute(context)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.plgs
        self.into_settings(settings)
        if self.scene_folder:
            settings.scene_folder = self.scene_folder
        return self.import_it(context)


class PLGS_OT_browse_scene(SceneOptions, bpy.types.Operator):
    """Import the cameras and images of posed frames: a folder, or a file such as transforms.json, .sens or .r3d"""

    bl_idname, bl_label, bl_options = "plgs.browse_scene", "PLGS Scene", {"UNDO", "PRESET"}

    filepath: StringProperty(  # type: ignore[valid-type]
        name="File", subtype="FILE_PATH", options={"SKIP_SAVE"},
        description="The scene's file, any file out of its folder, or the folder itself",
    )  # fmt: skip
    filter_glob: StringProperty(  # type: ignore[valid-type]
        default=";".join(f"*{suffix}" for suffix in FILE_SUFFIXES), options={"HIDDEN", "SKIP_SAVE"}
    )

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.waits = False
        context.window_manager.fileselect_add(self)
        return RUNNING

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.plgs
        place = scene_at(Path(absolute(self.filepath)), chosen_format(self.format))
        _forget_other_scene(settings)
        self.into_settings(settings)
        settings.scene_folder = str(place)
        return self.import_it(context)


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
            if not settings.scene_folder or absolute(settings.scene_folder) != scene:
                _forget_other_scene(settings)
            settings.scene_folder = str(scene)
        self.report({"INFO"}, f"PLGS: {lift or scene}")
        return FINISHED


class PLGS_FH_scene(bpy.types.FileHandler):
    """A file of a scene or a lift, dropped on a 3D view, opens what it is part of"""

    bl_idname, bl_label = "PLGS_FH_scene", "PLGS scene or lift"
    bl_import_operator, bl_file_extensions = "plgs.open_dropped", ";".join(FILE_SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


CLASSES = (
    PLGS_OT_import_scene,
    PLGS_OT_browse_scene,
    PLGS_OT_look_at_scene,
    PLGS_OT_open_dropped,
    PLGS_FH_scene,
)
