"""Selecting, showing and colouring the instances and classes of a lift."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ..plgs_blender import splats
from ..plgs_blender.inspecting import selection, visibility
from ..plgs_blender.inspecting.lookup import chosen_row, class_row_of, find_lift, row_of
from ..plgs_blender.lift_collection import lifts_in
from ..plgs_blender.viewport import show_lift_colours
from .answers import CANCELLED, FINISHED, panel_of, reporting


class OnLift:
    """An operator on a lift of the scene. `lift` names it by its folder or its collection's name."""

    if TYPE_CHECKING:
        poll_message_set: Callable[[str], None]

    lift: StringProperty(  # type: ignore[valid-type]
        name="Lift", options={"SKIP_SAVE"},
        description="Folder or collection of the lift; empty: the active object's, else the scene's first",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not any(len(root.plgs.classes) for root in lifts_in(context.scene)):
            cls.poll_message_set("This scene has no result of a lift yet")
            return False
        return True

    def root(self, context: bpy.types.Context) -> bpy.types.Collection:
        """The lift's collection. Raises JobError."""
        return find_lift(context.scene, self.lift, context.active_object)


class OnInstance(OnLift):
    """An operator on one instance of a lift."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if panel_of(context) is not None and chosen_row(context.scene, context.active_object) is None:
            cls.poll_message_set("Choose an instance: click its box in the view, or its row in the list")
            return False
        return super().poll(context)

    instance: IntProperty(  # type: ignore[valid-type]
        name="Instance", min=0, options={"SKIP_SAVE"}, description="Id of the instance; 0: the one selected in the list"
    )


class PLGS_OT_select_instance(OnInstance, bpy.types.Operator):
    """Select an instance: its box, its row in the list, its points and anchors"""

    bl_idname, bl_label, bl_options = "plgs.select_instance", "Select Instance", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        selection.select_instance(root, self.instance, context.view_layer)
        row = row_of(root, self.instance)
        if selection.selected_instance(root, context.view_layer.objects.active) != row.instance_id:
            self.report({"WARNING"}, f"The box of {row.name} is hidden or gone: only its row is selected")
        return FINISHED


class PLGS_OT_select_class(OnLift, bpy.types.Operator):
    """Select the boxes of all instances of a class"""

    bl_idname, bl_label, bl_options = "plgs.select_class", "Select Class", {"REGISTER", "UNDO"}

    class_id: IntProperty(name="Class", min=0, options={"SKIP_SAVE"}, description="Id of the class")  # type: ignore[valid-type]

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        row = class_row_of(root, self.class_id)
        if not selection.select_class(root, self.class_id, context.view_layer):
            self.report({"WARNING"}, f"{row.name} has no box to select")
            return CANCELLED
        return FINISHED


class PLGS_OT_toggle_instance_visibility(OnInstance, bpy.types.Operator):
    """Hide or show an instance: its box, its points and its anchors"""

    bl_idname, bl_label, bl_options = "plgs.toggle_instance_visibility", "Hide or Show Instance", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        row = row_of(self.root(context), self.instance)
        row.visible = not row.visible
        return FINISHED


class PLGS_OT_toggle_class_visibility(OnLift, bpy.types.Operator):
    """Hide or show a class: its points, its anchors and the boxes of its instances"""

    bl_idname, bl_label, bl_options = "plgs.toggle_class_visibility", "Hide or Show Class", {"REGISTER", "UNDO"}

    class_id: IntProperty(name="Class", min=0, options={"SKIP_SAVE"}, description="Id of the class")  # type: ignore[valid-type]

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        row = class_row_of(self.root(context), self.class_id)
        row.visible = not row.visible
        return FINISHED


class PLGS_OT_isolate_instance(OnInstance, bpy.types.Operator):
    """Show only this instance; again, show what was shown before"""

    bl_idname, bl_label, bl_options = "plgs.isolate_instance", "Show Only It", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        visibility.isolate(self.root(context), self.instance)
        return FINISHED


class PLGS_OT_show_all(OnLift, bpy.types.Operator):
    """Show all instances and classes again"""

    bl_idname, bl_label, bl_options = "plgs.show_all", "Show All", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        visibility.show_all(self.root(context))
        return FINISHED


class PLGS_OT_colour_boxes(OnLift, bpy.types.Operator):
    """Colour the boxes by instance or by class"""

    bl_idname, bl_label, bl_options = "plgs.colour_boxes", "Colour Boxes", {"REGISTER", "UNDO"}

    by: EnumProperty(  # type: ignore[valid-type]
        name="By",
        items=[
            ("TOGGLE", "Other", "The one that it is not now"),
            ("INSTANCE", "Instance", "Each box in a colour of its own"),
            ("CLASS", "Class", "Boxes in the colours of their classes"),
        ],
        default="TOGGLE",
    )

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        lists = self.root(context).plgs
        other = {"INSTANCE": "CLASS", "CLASS": "INSTANCE"}[lists.box_colours]
        lists.box_colours = other if self.by == "TOGGLE" else self.by
        return FINISHED


class PLGS_OT_show_colours(bpy.types.Operator):
    """Let this view show the lift's colours in Solid shading: points by class, boxes by instance"""

    bl_idname, bl_label = "plgs.show_colours", "Show Colours in This View"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("There is no 3D view here")
        return context.space_data is not None and context.space_data.type == "VIEW_3D"

    def execute(self, context: bpy.types.Context) -> set[str]:
        show_lift_colours(context.space_data)
        return FINISHED


class PLGS_OT_place_gaussians(OnLift, bpy.types.Operator):
    """Import the lift's Gaussians as Blender's native splats"""

    bl_idname, bl_label, bl_options = "plgs.place_gaussians", "Show Gaussians", {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not splats.has_native_splats():
            cls.poll_message_set(splats.WHY_NOT)
            return False
        return super().poll(context)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        splats.place_gaussians(self.root(context), context.scene)
        return FINISHED


CLASSES = (
    PLGS_OT_select_instance,
    PLGS_OT_select_class,
    PLGS_OT_toggle_instance_visibility,
    PLGS_OT_toggle_class_visibility,
    PLGS_OT_isolate_instance,
    PLGS_OT_show_all,
    PLGS_OT_colour_boxes,
    PLGS_OT_show_colours,
    PLGS_OT_place_gaussians,
)
