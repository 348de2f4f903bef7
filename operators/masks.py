"""Masks for a scene that has none, and the classes of those that it has."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender.engine_environment import usable_python
from ..plgs_blender.mask_classes import OWN_TABLE, TABLE_ITEMS, fill_classes, write_classes
from ..plgs_blender.running import mask_making, poll_timer
from ..plgs_blender.running.start import why_no_engine
from ..plgs_blender.settings import place_of
from .answers import FINISHED, panel_of, reporting, reporting_events


class PLGS_OT_make_masks(bpy.types.Operator):
    """Let a network make a panoptic mask of every frame. It is downloaded only where Blender may go online"""

    bl_idname, bl_label = "plgs.make_masks", "Make Masks"

    model: StringProperty(  # type: ignore[valid-type]
        name="Model", options={"SKIP_SAVE"}, description="Folder or name of a Mask2Former; empty: the panel's"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = "The engine makes masks already" if mask_making.is_making() else None
        if reason is None and panel_of(context) is not None:
            reason = why_no_engine() if context.scene.plgs.scene_folder else "Choose the scene's folder first"
        if reason is not None:
            cls.poll_message_set(reason)
        return reason is None

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._begin(context)
        return FINISHED

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self._begin(context)
        mask_making.wait()
        return FINISHED

    def _begin(self, context: bpy.types.Context) -> None:
        model = self.model or context.scene.plgs_masks.model
        if context.scene.plgs.masks:
            self.report({"WARNING"}, "The panel names other masks: the new ones count when Masks is empty")
        # Blender's own setting is the user's consent to downloads.
        mask_making.begin(place_of(context.scene.plgs), usable_python(), model, download=bpy.app.online_access)


class PLGS_OT_cancel_masks(bpy.types.Operator):
    """Stop making masks; those that are made are kept, and the next time goes on"""

    bl_idname, bl_label = "plgs.cancel_masks", "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No masks are being made")
        return mask_making.is_making()

    def execute(self, context: bpy.types.Context) -> set[str]:
        mask_making.stop()
        return FINISHED


class PLGS_OT_read_classes(bpy.types.Operator):
    """List the classes of the scene's masks, to name and merge them"""

    bl_idname, bl_label, bl_options = "plgs.read_classes", "Read Classes", {"UNDO"}

    table: EnumProperty(  # type: ignore[valid-type]
        name="Table", options={"SKIP_SAVE"}, default=OWN_TABLE, items=TABLE_ITEMS,
        description="Begin with a public table, for masks whose files do not tell their classes",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Choose the scene's folder first")
        return bool(context.scene.plgs.scene_folder)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        fill_classes(context.scene.plgs_masks, place_of(context.scene.plgs), self.table)
        return FINISHED


class PLGS_OT_write_classes(bpy.types.Operator):
    """Write the list into classes.toml beside the masks, where every later lift reads it"""

    bl_idname, bl_label = "plgs.write_classes", "Write Classes"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Read the classes first")
        return bool(context.scene.plgs.scene_folder) and len(context.scene.plgs_masks.classes) > 0

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        path = write_classes(context.scene.plgs_masks, place_of(context.scene.plgs))
        poll_timer.look_at_scene(place_of(context.scene.plgs))
        self.report({"INFO"}, f"PLGS: {path}")
        return FINISHED


CLASSES = (PLGS_OT_make_masks, PLGS_OT_cancel_masks, PLGS_OT_read_classes, PLGS_OT_write_classes)
