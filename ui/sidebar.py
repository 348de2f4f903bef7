"""The panel Lift Panoptic Masks in the tab PLGS of the 3D view's sidebar, and what its parts share."""

from __future__ import annotations

import textwrap

import bpy

from ..plgs_blender.panel_words import in_panel_words

_PIXELS_A_LETTER = 7.0
"""Of the interface's font at scale 1, on average."""


class Sidebar:
    """Where a panel of ours lies."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "PLGS"


class PLGS_PT_lift_panoptic_masks(Sidebar, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_lift_panoptic_masks", "Lift Panoptic Masks"

    def draw(self, context: bpy.types.Context) -> None:
        """Nothing: the steps below it are panels of their own."""


class Step(Sidebar):
    """One step of the work, in order: set `bl_order`."""

    bl_parent_id = PLGS_PT_lift_panoptic_masks.bl_idname


def tell(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """A text of any length, wrapped to the sidebar's width: Blender's own labels are cut off. What the engine advises
    is told in the panel's words."""
    scale = context.preferences.system.ui_scale
    letters = max(20, int(context.region.width / (_PIXELS_A_LETTER * scale)) - 5)
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(in_panel_words(text), letters) or [""]):
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


def from_panel(layout: bpy.types.UILayout, context: bpy.types.Context) -> bpy.types.UILayout:
    """Let the buttons in a layout be grey for what the panel is set to; a script's arguments may say otherwise."""
    layout.context_pointer_set("plgs_panel", context.scene.plgs)
    return layout


def duration(seconds: float) -> str:
    """Such as "2 min 40 s" or "1 h 05 min"."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


CLASSES = (PLGS_PT_lift_panoptic_masks,)
