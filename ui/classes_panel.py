"""Making masks, and the classes of those that are there: below step 1."""

from __future__ import annotations

import bpy

from ..plgs_blender.running import mask_making
from ..plgs_blender.settings import place_of
from .sidebar import Sidebar, from_panel, tell


class PLGS_UL_mask_classes(bpy.types.UIList):
    """Number, name, what it counts as, and whether that is a thing."""

    def draw_item(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, data: object, item: bpy.types.PropertyGroup,
        icon: int, active_data: object, active_property: str, index: int = 0, flag: int = 0,
    ) -> None:  # fmt: skip
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False)
        row.prop(item, "into", text="", icon="FORWARD")
        row.prop(item, "is_thing", text="")


class PLGS_PT_scene_masks(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_scene_masks", "Masks and classes"
    bl_parent_id, bl_options = "PLGS_PT_scene", {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, masks = self.layout, context.scene.plgs_masks
        if mask_making.is_making():
            tell(layout, context, mask_making.progress(), "SORTTIME")
            layout.operator("plgs.cancel_masks", icon="X")
        else:
            settings = context.scene.plgs
            problem = mask_making.error_for(place_of(settings)) if settings.scene_folder else None
            if problem is not None:
                tell(layout, context, problem, "ERROR")
            layout.prop(masks, "model")
            from_panel(layout.row(), context).operator("plgs.make_masks", icon="MOD_MASK")
        row = layout.row(align=True)
        row.operator("plgs.read_classes", icon="FILE_REFRESH")
        row.operator_menu_enum("plgs.read_classes", "table", text="", icon="DOWNARROW_HLT")
        if len(masks.classes):
            layout.template_list("PLGS_UL_mask_classes", "", masks, "classes", masks, "active", rows=5)
            layout.operator("plgs.write_classes", icon="FILE_TICK")


CLASSES = (PLGS_UL_mask_classes, PLGS_PT_scene_masks)
