"""Finding poses for photos, making masks for a scene that has none, and editing the classes of its masks."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..plgs_blender.engine_environment import usable_python, why_no_engine
from ..plgs_blender.mask_classes import OWN_TABLE, TABLE_ITEMS
from ..plgs_blender.running.adding import why_lacking
from ..plgs_blender.running.classes import read_classes, write_classes
from ..plgs_blender.running.preparation import MaskMaking, PoseMaking, make_masks, make_poses
from ..plgs_blender.settings import chosen_scene
from ..plgs_blender.tasks import registry
from ..plgs_blender.tasks.registry import Task
from .base import CancelsTask, StartsTask, panel_of


class PLGS_OT_make_masks(StartsTask, bpy.types.Operator):
    """Have a network make a panoptic mask of every frame. It is downloaded only if Blender may go online"""

    bl_idname, bl_label = "plgs.make_masks", "Make Masks"

    model: StringProperty(  # type: ignore[valid-type]
        name="Model", options={"SKIP_SAVE"}, description="Folder or name of a Mask2Former; empty: the panel's"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(MaskMaking):
            return "The engine is already making masks"
        if panel_of(context) is None:
            return None
        if not context.scene.plgs.scene_folder:
            return "Choose the scene's folder first"
        return why_no_engine() or why_lacking("segment")

    def begin(self, context: bpy.types.Context) -> Task:
        model = self.model or context.scene.plgs_masks.model
        if context.scene.plgs.masks:
            self.report({"WARNING"}, "The panel names other masks: the new ones are used once Masks is empty")
        # Blender's own setting is the user's consent to downloads.
        return make_masks(chosen_scene(context.scene.plgs), usable_python(), model, download=bpy.app.online_access)


class PLGS_OT_make_poses(StartsTask, bpy.types.Operator):
    """Have COLMAP find the poses of the scene's photos, or of a film's sharpest pictures, and write them beside it"""

    bl_idname, bl_label = "plgs.make_poses", "Find Poses"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(PoseMaking):
            return "The engine is already finding poses"
        if not context.scene.plgs.scene_folder:
            return "Choose the scene's folder first"
        return why_no_engine() or why_lacking("colmap")

    def begin(self, context: bpy.types.Context) -> Task:
        return make_poses(chosen_scene(context.scene.plgs), usable_python())


class PLGS_OT_cancel_poses(CancelsTask, bpy.types.Operator):
    """Stop finding poses; nothing is written"""

    bl_idname, bl_label = "plgs.cancel_poses", "Cancel"
    cancelled_kind = PoseMaking


class PLGS_OT_cancel_masks(CancelsTask, bpy.types.Operator):
    """Stop making masks; finished masks are kept, and the next run continues"""

    bl_idname, bl_label = "plgs.cancel_masks", "Cancel"
    cancelled_kind = MaskMaking


class PLGS_OT_read_classes(StartsTask, bpy.types.Operator):
    """List the classes of the scene's masks, to name and merge them"""

    bl_idname, bl_label, bl_options = "plgs.read_classes", "Read Classes", {"UNDO"}

    table: EnumProperty(  # type: ignore[valid-type]
        name="Table", options={"SKIP_SAVE"}, default=OWN_TABLE, items=TABLE_ITEMS,
        description="Start from a public table, for masks whose files do not name their classes",
    )  # fmt: skip

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if not context.scene.plgs.scene_folder:
            return "Choose the scene's folder first"
        return why_no_engine()

    def begin(self, context: bpy.types.Context) -> Task:
        return read_classes(context.scene, self.table)


class PLGS_OT_write_classes(StartsTask, bpy.types.Operator):
    """Write the list to classes.toml beside the masks, where every later lift reads it"""

    bl_idname, bl_label = "plgs.write_classes", "Write Classes"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if not context.scene.plgs.scene_folder or not len(context.scene.plgs_masks.classes):
            return "Read the classes first"
        return why_no_engine()

    def begin(self, context: bpy.types.Context) -> Task:
        return write_classes(context.scene)


CLASSES = (
    PLGS_OT_make_poses,
    PLGS_OT_cancel_poses,
    PLGS_OT_make_masks,
    PLGS_OT_cancel_masks,
    PLGS_OT_read_classes,
    PLGS_OT_write_classes,
)
