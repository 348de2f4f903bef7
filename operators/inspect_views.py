"""Looking at an instance of a lift: from where the view is, from its best frame, from the masks that made it."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ..plgs_blender.inspecting import views
from ..plgs_blender.viewport import view_of
from .answers import CANCELLED, FINISHED, reporting
from .inspect import OnInstance, OnLift


class PLGS_OT_frame_instance(OnInstance, bpy.types.Operator):
    """Move the view so that the instance fills it"""

    bl_idname, bl_label = "plgs.frame_instance", "Frame It"

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        view, aspect = view_of(context)
        if view is None:
            self.report({"ERROR"}, "There is no 3D view to move")
            return CANCELLED
        views.frame_instance(self.root(context), self.instance, view, aspect)
        return FINISHED


class PLGS_OT_go_to_best_view(OnInstance, bpy.types.Operator):
    """Look through the camera of the frame that sees most of the instance"""

    bl_idname, bl_label, bl_options = "plgs.go_to_best_view", "Go to Its Best View", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        frame = views.best_frame(root, self.instance)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])
        self.report({"INFO"}, f"Frame {frame}")
        return FINISHED


class PLGS_OT_go_to_mask(OnInstance, bpy.types.Operator):
    """Look through the camera of the frame in which this mask of the instance lies"""

    bl_idname, bl_label, bl_options = "plgs.go_to_mask", "Go to Mask", {"REGISTER", "UNDO"}

    frame: StringProperty(  # type: ignore[valid-type]
        name="Frame", options={"SKIP_SAVE"},
        description="Name of the frame; empty: that of the mask selected in the list",
    )  # fmt: skip
    segment: IntProperty(  # type: ignore[valid-type]
        name="Segment", min=0, options={"SKIP_SAVE"},
        description="Id of the segment in the frame's mask; 0: the first that made the instance",
    )  # fmt: skip

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        frame = views.mask_frame(root, self.instance, self.frame, self.segment)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])
        return FINISHED


class PLGS_OT_toggle_overlay(OnLift, bpy.types.Operator):
    """Draw names, a legend or the selected points over the 3D views, or stop it"""

    bl_idname, bl_label, bl_options = "plgs.toggle_overlay", "Toggle Overlay", {"REGISTER", "UNDO"}

    part: EnumProperty(  # type: ignore[valid-type]
        name="Part",
        options={"SKIP_SAVE"},
        items=[
            ("LABELS", "Labels", "The instances' names at their boxes"),
            ("LEGEND", "Legend", "The classes and their colours"),
            ("SELECTED", "Selected points", "The points and anchors of the selected instance"),
        ],
        default="LABELS",
    )

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        lists = self.root(context).plgs
        name = {"LABELS": "show_labels", "LEGEND": "show_legend", "SELECTED": "show_selected"}[self.part]
        setattr(lists, name, not getattr(lists, name))
        return FINISHED


CLASSES = (PLGS_OT_frame_instance, PLGS_OT_go_to_best_view, PLGS_OT_go_to_mask, PLGS_OT_toggle_overlay)
