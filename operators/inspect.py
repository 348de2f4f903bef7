"""Operators that select, show, colour and view the instances and classes of a lift, and reuse them elsewhere."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from ..plgs_blender import corrections, reuse
from ..plgs_blender.errors import one_line, plural
from ..plgs_blender.inspecting import looks, selection, views
from ..plgs_blender.inspecting.lists import WAYS_TO_SHOW
from ..plgs_blender.inspecting.selection import chosen_row, class_row_of, find_lift, row_of
from ..plgs_blender.lift_scene import show_lift_as
from ..plgs_blender.owned import lifts_in
from ..plgs_blender.viewport import show_lift_colours, view_of
from .base import CANCELLED, FINISHED, Acts, argument, panel_of, reporting, text_argument


class OnLift(Acts):
    """An operator on a lift of the scene. `lift` names it by its folder or its collection's name."""

    lift: text_argument("Lift", "Folder or collection of the lift; empty: the active object's, else the scene's first")

    @staticmethod
    def room(scene: bpy.types.Scene) -> bpy.types.Scene:
        """Return the scene whose lifts the operator works on."""
        return scene

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        has_result = any(len(root.plgs.classes) for root in lifts_in(cls.room(context.scene)))
        return None if has_result else "This scene has no lift result yet"

    def root(self, context: bpy.types.Context) -> bpy.types.Collection:
        """Return the lift's collection. Raises PlgsError if there is no such lift."""
        return find_lift(self.room(context.scene), self.lift, context.active_object)

    def act(self, context: bpy.types.Context) -> str | None:
        return self.act_on(context, self.root(context))

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str | None:
        """Do the operator's work on a lift. Returns a line to report, or None. A PlgsError or OSError is reported."""
        raise NotImplementedError


class OnChosen(OnLift):
    """An operator on the instance chosen in a lift; its button is grey while no instance is chosen."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if panel_of(context) is not None and chosen_row(cls.room(context.scene), context.active_object) is None:
            return "Choose an instance: click it in the view, or its row in the list"
        return super().why_not(context)


class OnInstance(OnChosen):
    """An operator on one instance of a lift, given by its id."""

    instance: argument(IntProperty, "Instance", "Id of the instance; 0: the one selected in the list", min=0)


class OnInstances(OnChosen):
    """An operator on several instances of a lift, by default the selected ones."""

    instances: text_argument(
        "Instances", "Ids such as 3 5, or all; empty: the selected boxes, the active one first, else the list's row"
    )


class OnClass(OnLift):
    """An operator on one class of a lift, given by its id."""

    class_id: argument(IntProperty, "Class", "Id of the class", min=0)


class PLGS_OT_select_instance(OnInstance, bpy.types.Operator):
    """Select an instance: its box, its row in the list, its points and anchors"""

    bl_idname, bl_label, bl_options = "plgs.select_instance", "Select Instance", {"REGISTER", "UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        selection.select_instance(root, self.instance, context.view_layer)
        row = row_of(root, self.instance)
        if selection.selected_instance(root, context.view_layer.objects.active) != row.instance_id:
            self.report({"WARNING"}, f"The box of {one_line(row.name)} is hidden or gone: only its row is selected")


class PLGS_OT_select_class(OnClass, bpy.types.Operator):
    """Select the boxes of all instances of a class"""

    bl_idname, bl_label, bl_options = "plgs.select_class", "Select Class", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        row = class_row_of(root, self.class_id)
        if not selection.select_class(root, self.class_id, context.view_layer):
            self.report({"WARNING"}, f"{one_line(row.name)} has no box to select")
            return CANCELLED
        return FINISHED


class PLGS_OT_toggle_instance_visibility(OnInstance, bpy.types.Operator):
    """Hide or show an instance: its box, its points and its anchors"""

    bl_idname, bl_label, bl_options = "plgs.toggle_instance_visibility", "Hide or Show Instance", {"REGISTER", "UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        row = row_of(root, self.instance)
        row.visible = not row.visible


class PLGS_OT_isolate_instance(OnInstance, bpy.types.Operator):
    """Show only this instance, and frame it. Press again to go back"""

    bl_idname, bl_label, bl_options = "plgs.isolate_instance", "Isolate", {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        is_alone = any(root.plgs.isolated for root in lifts_in(context.scene))  # the same button then shows all again
        return OnLift.why_not(context) if is_alone else super().why_not(context)

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        nothing_chosen = chosen_row(context.scene, context.active_object) is None
        looks.isolate(root, self.instance or (root.plgs.isolated if nothing_chosen else 0))
        view, aspect = view_of(context)
        if view is not None:
            views.show_alone(root, view, aspect)


class PLGS_OT_choose_lift(OnLift, bpy.types.Operator):
    """Let the panels show this lift. The eye beside it hides it in the view"""

    bl_idname, bl_label, bl_options = "plgs.choose_lift", "Choose Lift", {"UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        selection.choose_lift(root, context.scene, context.view_layer)


class PLGS_OT_show_all(OnLift, bpy.types.Operator):
    """Show all instances and classes again"""

    bl_idname, bl_label, bl_options = "plgs.show_all", "Show All", {"REGISTER", "UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        looks.show_all(root)


class PLGS_OT_show_as(OnLift, bpy.types.Operator):
    """Show the lift as points, splats or a surface; the other two are hidden"""

    bl_idname, bl_label, bl_options = "plgs.show_as", "Show As", {"REGISTER", "UNDO"}

    kind: EnumProperty(name="Kind", items=WAYS_TO_SHOW)

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        show_lift_as(root, context.scene, self.kind)


class PLGS_OT_show_colours(Acts, bpy.types.Operator):
    """Show the lift's colours in this view's Solid shading: points by class, boxes by instance"""

    bl_idname, bl_label = "plgs.show_colours", "Show Colours in This View"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        is_view = context.space_data is not None and context.space_data.type == "VIEW_3D"
        return None if is_view else "There is no 3D view here"

    def act(self, context: bpy.types.Context) -> None:
        show_lift_colours(context.space_data)
        looks.show_pictures_in(context.scene)


class PLGS_OT_frame_instance(OnInstance, bpy.types.Operator):
    """Move the view so that the instance fills it"""

    bl_idname, bl_label = "plgs.frame_instance", "Frame Selected"

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

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        frame = views.best_frame(root, self.instance)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])
        return f"Frame {one_line(frame)}"


class PLGS_OT_go_to_mask(OnInstance, bpy.types.Operator):
    """Look through the camera of this mask's frame"""

    bl_idname, bl_label, bl_options = "plgs.go_to_mask", "Go to Mask", {"REGISTER", "UNDO"}

    frame: text_argument("Frame", "Name of the frame; empty: that of the mask selected in the list")
    segment: argument(
        IntProperty, "Segment", "Id of the segment in the frame's mask; 0: the first one that made the instance", min=0
    )

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        frame = views.mask_frame(root, self.instance, self.frame, self.segment)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])


class PLGS_OT_go_to_frame(OnLift, bpy.types.Operator):
    """Look through the camera of this frame"""

    bl_idname, bl_label, bl_options = "plgs.go_to_frame", "Go to Frame", {"REGISTER", "UNDO"}

    frame: text_argument("Frame")

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        views.look_from_frame(root, self.frame, context.scene, view_of(context)[0])


class PLGS_OT_make_objects(OnInstances, bpy.types.Operator):
    """Turn each selected object into a mesh in its own collection, to move and reuse. It leaves a hole in the lift"""

    bl_idname, bl_label, bl_options = "plgs.make_objects", "Make Objects", {"REGISTER", "UNDO"}

    as_assets: argument(BoolProperty, "As Assets", "Mark them as assets, each with a preview picture")

    catch_shadows: argument(BoolProperty, "Catch Shadows", "Show only the shadows that they catch")

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        numbers = corrections.chosen_instances(root, self.instances, context)
        made = reuse.make_objects(root, numbers, as_assets=self.as_assets, catch_shadows=self.catch_shadows)
        return one_line(f"Made: {', '.join(each.name for each in made)}")


class PLGS_OT_key_visibility(OnInstances, bpy.types.Operator):
    """Key the selected objects to be visible only in the frames whose masks show them"""

    bl_idname, bl_label, bl_options = "plgs.key_visibility", "Key Visibility", {"REGISTER", "UNDO"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        numbers = corrections.chosen_instances(root, self.instances, context)
        return plural(reuse.key_visibility(root, numbers, context.scene), "object has keys", "objects have keys")
