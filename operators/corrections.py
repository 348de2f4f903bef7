"""Operators that correct a lift: names, classes, which points belong to which object; and answer proposals."""

from __future__ import annotations

from functools import partial
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatVectorProperty, IntProperty

from ..plgs_blender import correction_tools, corrections, registry, reuse
from ..plgs_blender.correction_tools import Painting, RemoveObjects, SplitByViews, remove_objects, split_by_views
from ..plgs_blender.engine_environment import why_no_engine
from ..plgs_blender.errors import EXPECTED, PlgsError, one_line, plural
from ..plgs_blender.inspecting import selection, views
from ..plgs_blender.inspecting.selection import chosen_row, find_lift, row_of
from ..plgs_blender.owned import folder_of
from ..plgs_blender.proposals import next_uncertain, proposal_of, propose
from ..plgs_blender.registry import Task
from ..plgs_blender.viewport import view_of
from . import base
from .inspect import OnInstance, OnInstances, OnLift

_UNDOABLE = {"REGISTER", "UNDO"}
_STEP = 1.2  # factor by which one step of the mouse wheel scales the brush


def _class_choices(self: Any, context: bpy.types.Context, _text: str) -> list[str]:
    """Return suggestions for a dialog's class field: the classes of the lift."""
    try:
        root = find_lift(context.scene, self.lift, context.active_object)
        row = chosen_row(context.scene, context.active_object)
        return corrections.class_choices(root, 0 if row is None else row.instance_id)
    except EXPECTED:  # while the user types: the operator itself reports what is wrong
        return []


_class_argument = partial(
    base.text_argument,
    "Class",
    "The class's name. Classes that the object's masks voted for come first",
    search=_class_choices,
)


class AsksForOne:
    """An operator whose dialog shows only the property ``asked``, ready for typing. A script may give others, too."""

    asked: str
    layout: bpy.types.UILayout

    def draw(self, context: bpy.types.Context) -> None:
        field = self.layout.column()
        field.activate_init = True
        field.prop(self, self.asked)


class PLGS_OT_rename_instance(AsksForOne, OnInstance, bpy.types.Operator):
    """Rename the object"""

    bl_idname, bl_label, bl_options = "plgs.rename_instance", "Rename Object", _UNDOABLE
    asked = "name"

    name: base.text_argument("Name", "The name, up to 60 characters")

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        root = self.root(context)
        number = row_of(root, self.instance).instance_id
        root.plgs.instance_index = next(at for at, row in enumerate(root.plgs.instances) if row.instance_id == number)
        bpy.ops.wm.call_panel(name="PLGS_PT_name", keep_open=False)  # one Return ends it, as Blender's own F2
        return {"INTERFACE"}

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        corrections.rename(root, row_of(root, self.instance).instance_id, self.name)


class PLGS_OT_reclass_instances(AsksForOne, OnInstances, bpy.types.Operator):
    """Change the class of the objects. A stuff class has no objects: their points simply become that stuff"""

    bl_idname, bl_label, bl_options = "plgs.reclass_instances", "Change Class", _UNDOABLE
    asked = "class_name"

    class_name: _class_argument()

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return set(context.window_manager.invoke_props_dialog(self))

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        numbers = corrections.chosen_instances(root, self.instances, context)
        corrections.reclass(root, numbers, self.class_name)


class PLGS_OT_merge_instances(OnInstances, bpy.types.Operator):
    """Merge the selected objects into one, with the name and class of the active object"""

    bl_idname, bl_label, bl_options = "plgs.merge_instances", "Merge Selected", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        corrections.merge(root, corrections.chosen_instances(root, self.instances, context))


class PLGS_OT_delete_instance(OnInstance, bpy.types.Operator):
    """Dissolve an object that was found by mistake: its points become part of what is around it"""

    bl_idname, bl_label, bl_options = "plgs.delete_instance", "Dissolve Object", _UNDOABLE

    becomes: EnumProperty(
        name="Points Become",
        items=[
            ("AROUND", "Surroundings", "Each point takes the label of the nearest point outside the object"),
            ("NO_OBJECT", "No Object", "The points keep their class but belong to no object"),
        ],
    )

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        corrections.delete(root, row_of(root, self.instance).instance_id, around=self.becomes == "AROUND")


class PLGS_OT_remove_instances(base.StartsTask, OnInstances, bpy.types.Operator):
    """Take the objects out of the room: an engine draws what other photos saw behind them, and fills in the rest"""

    bl_idname, bl_label = "plgs.remove_instances", "Remove (Clean Plate)"

    make_objects: base.argument(BoolProperty, "Make Objects", "Keep each as a mesh of its own, which you can move")

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(RemoveObjects):
            return "The engine is already removing objects"
        return super().why_not(context) or (why_no_engine() if base.panel_of(context) is not None else None)

    def begin(self, context: bpy.types.Context) -> Task:
        root = self.root(context)
        numbers = corrections.chosen_instances(root, self.instances, context)
        if self.make_objects:
            reuse.make_objects(root, numbers, as_assets=False)
        return remove_objects(root, numbers)


class PLGS_OT_put_back(OnLift, bpy.types.Operator):
    """Put a removed object back, with all that were removed together with it"""

    bl_idname, bl_label, bl_options = "plgs.put_back", "Put Back", _UNDOABLE

    instance: base.argument(IntProperty, "Instance", "Id of the removed object; 0: the last one", min=0)

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        removed = corrections.removed_objects(root)
        corrections.put_back(root, self.instance or max(removed, default=0))


_SPLITS = [
    ("PARTS", "Connected Parts", "Separate the object's parts that do not touch; the largest part keeps the name"),
    ("CUT", "Cutting Plane", "Cut the object along the plane that Add Plane placed, wherever you have moved it"),
    ("PLANE", "Plane", "Cut the object along the plane through a point, perpendicular to a normal"),
]


class PLGS_OT_split_instance(OnInstance, bpy.types.Operator):
    """Split the object into several"""

    bl_idname, bl_label, bl_options = "plgs.split_instance", "Split", _UNDOABLE

    by: base.argument(EnumProperty, "By", items=_SPLITS)
    point: base.argument(FloatVectorProperty, "Point", "On the plane, metres", subtype="XYZ")
    normal: base.argument(
        FloatVectorProperty, "Normal", "Towards the side that becomes a new object", subtype="XYZ", default=(1, 0, 0)
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return next(text for way, _, text in _SPLITS if way == properties.by)

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        number = row_of(root, self.instance).instance_id
        if self.by == "CUT":
            edit = correction_tools.split_by_cut(root, number)
        elif self.by == "PLANE":
            edit = corrections.split_plane(root, number, (*self.point,), (*self.normal,))
        else:
            edit = corrections.split_parts(root, number)
        return one_line(f"New: {', '.join(one.name for one in edit.made)}")


class PLGS_OT_split_by_views(base.StartsTask, OnInstance, bpy.types.Operator):
    """Split the object into the parts that the masks of at least two frames separate, each with its masks' class"""

    bl_idname, bl_label = "plgs.split_by_views", "Split by Views"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(SplitByViews):
            return "The engine is already reading the masks"
        # A script waits for the engine's answer; a button is grey until there is one.
        return super().why_not(context) or (why_no_engine() if base.panel_of(context) is not None else None)

    def begin(self, context: bpy.types.Context) -> Task:
        root = self.root(context)
        return split_by_views(root, row_of(root, self.instance).instance_id)


class PLGS_OT_place_cut(OnInstance, bpy.types.Operator):
    """Add a plane through the object. Move and rotate it to where you want to split the object"""

    bl_idname, bl_label, bl_options = "plgs.place_cut", "Add Cutting Plane", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        correction_tools.place_cut(root, row_of(root, self.instance).instance_id)


class PLGS_OT_crop_instance(OnInstance, bpy.types.Operator):
    """Give the object all points of its class inside its box. Move or scale the box first"""

    bl_idname, bl_label, bl_options = "plgs.crop_instance", "Crop to Its Box", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        corrections.crop(root, row_of(root, self.instance).instance_id)


class PLGS_OT_accept_instances(OnInstances, bpy.types.Operator):
    """Mark these objects as correct: they are not proposed for correction again"""

    bl_idname, bl_label, bl_options = "plgs.accept_instances", "Accept", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> None:
        corrections.accept(root, corrections.chosen_instances(root, self.instances, context))


class PLGS_OT_undo_correction(OnLift, bpy.types.Operator):
    """Undo the last correction of this lift, even one from an earlier session or another program"""

    bl_idname, bl_label, bl_options = "plgs.undo_correction", "Undo Last Correction", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        return f"Undone: {corrections.undo_last(root).kind}"


class PLGS_OT_assign_points(OnLift, bpy.types.Operator):
    """Paint points, or name an object whose box contains them, and assign them to an object, a new object or a class"""

    bl_idname, bl_label, bl_options = "plgs.assign_points", "Paint Points", _UNDOABLE

    to: EnumProperty(
        name="To",
        items=[
            ("INSTANCE", "Object", "The object that is selected in the list"),
            ("NEW", "New Object", "A new object of a class"),
            ("CLASS", "Class", "A class, but no object"),
        ],
    )
    instance: base.argument(IntProperty, "Instance", "Id; 0: the selected object", min=0)
    class_name: _class_argument()
    region: base.text_argument("Region", "An object whose box contains the points; empty: paint them")

    @base.reporting
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.region:
            return self.execute(context)
        if context.area is None or context.area.type != "VIEW_3D":
            what = "points are painted in a 3D view"
            raise PlgsError("no-3d-view", what, "", "Press the button in a 3D view's sidebar.")
        root = self.root(context)
        if self.to == "INSTANCE":  # report what is missing before anything is painted
            row_of(root, self.instance)
        else:
            corrections.class_named(root, self.class_name)
        correction_tools.now[:] = [Painting.of_lift(folder_of(root))]
        context.window.cursor_modal_set("PAINT_BRUSH")
        context.window_manager.modal_handler_add(self)
        self._say(context)
        return base.RUNNING

    @base.reporting
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not correction_tools.now or context.area is None:  # another file was opened, or the view closed
            self.cancel(context)
            return base.CANCELLED
        now = correction_tools.now[0]
        view = next(region for region in context.area.regions if region.type == "WINDOW")
        mouse = (float(event.mouse_x - view.x), float(event.mouse_y - view.y))
        context.area.tag_redraw()
        if event.type == "MOUSEMOVE":
            now.move(mouse)
        elif event.type == "LEFTMOUSE" and event.value == "PRESS" and _is_over(context.area, event):
            now.press(mouse, is_box=event.shift, is_eraser=event.ctrl)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE" and now.drag:
            now.move(mouse)
            matrix = np.array(context.area.spaces.active.region_3d.perspective_matrix)
            now.release(matrix, (view.width, view.height))
        elif event.type in ("WHEELUPMOUSE", "WHEELDOWNMOUSE") and event.ctrl:
            now.radius *= _STEP if event.type == "WHEELUPMOUSE" else 1.0 / _STEP
            self._say(context)
        elif event.type in ("RET", "NUMPAD_ENTER") and event.value == "PRESS":
            self.cancel(context)
            self._assign(context, now.choose)
            return base.FINISHED
        elif event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return base.CANCELLED
        else:
            return base.PASSED_ON  # meanwhile the user may turn the view and use the panel
        return base.RUNNING

    def cancel(self, context: bpy.types.Context) -> None:
        """End painting. Blender also calls this if it ends the operator itself."""
        correction_tools.now.clear()
        if context.window is not None:
            context.window.cursor_modal_restore()
        if context.area is not None:
            context.area.header_text_set(None)

    def _say(self, context: bpy.types.Context) -> None:
        line = "Drag: paint points; Shift: rectangle; Ctrl: erase; Ctrl wheel: brush size; Enter: assign; Esc: cancel"
        context.area.header_text_set(line)

    @base.reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self._assign(context, corrections.in_region(self.region))
        return base.FINISHED

    def _assign(self, context: bpy.types.Context, choose: corrections.Choose) -> None:
        root = self.root(context)
        number = row_of(root, self.instance).instance_id if self.to == "INSTANCE" else 0
        corrections.assign(root, choose, number, self.class_name, is_new=self.to == "NEW")


def _is_over(area: bpy.types.Area, event: bpy.types.Event) -> bool:
    """Whether the mouse is over an area's view, and not over a bar or sidebar that covers it."""

    def holds(region: bpy.types.Region) -> bool:
        inside = 0 <= event.mouse_x - region.x < region.width and 0 <= event.mouse_y - region.y < region.height
        return inside and min(region.width, region.height) > 1  # a hidden region has one pixel

    return {region.type for region in area.regions if holds(region)} == {"WINDOW"}


class PLGS_OT_propose_corrections(OnLift, bpy.types.Operator):
    """Find objects that may be wrong: views disagree on the class, parts do not touch, or few frames saw the object"""

    bl_idname, bl_label, bl_options = "plgs.propose_corrections", "What May Be Wrong?", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        found = propose(root)
        return f"{plural(len(found.open), 'proposal')}, {found.progress}"


class OnProposal(OnLift):
    """An operator on the proposal about an instance."""

    instance: base.argument(IntProperty, "Instance", "Id of the instance; 0: the most doubtful one", min=0)


class PLGS_OT_go_to_proposal(OnProposal, bpy.types.Operator):
    """Select the object, and look through the camera of the frame that sees it best"""

    bl_idname, bl_label, bl_options = "plgs.go_to_proposal", "Look at It", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        one = proposal_of(root, self.instance)
        selection.select_instance(root, one.instance, context.view_layer)
        if one.frame:
            views.look_from_frame(root, one.frame, context.scene, view_of(context)[0])
        return one_line(f"{one.name}: {one.reason}")


class PLGS_OT_answer_proposal(base.StartsTask, OnProposal, bpy.types.Operator):
    """Apply the proposal, or keep the object as it is"""

    bl_idname, bl_label, bl_options = "plgs.answer_proposal", "Answer", _UNDOABLE

    keep: base.argument(BoolProperty, "Keep", "The object is correct as it is")

    def begin(self, context: bpy.types.Context) -> Task | None:
        root = self.root(context)
        one = proposal_of(root, self.instance)
        if one.answer == corrections.BY_VIEWS and not self.keep:
            return split_by_views(root, one.instance)
        corrections.answer(root, one.instance, keep=self.keep)
        return None


class PLGS_OT_next_uncertain_frame(OnLift, bpy.types.Operator):
    """Go to the frame in which the lift is least sure of the classes; press again for the next one"""

    bl_idname, bl_label, bl_options = "plgs.next_uncertain_frame", "Next Uncertain Frame", _UNDOABLE

    def act_on(self, context: bpy.types.Context, root: bpy.types.Collection) -> str:
        frame, visited, frames = next_uncertain(root)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])
        return f"Frame {one_line(frame)}, {visited} of {frames} visited"


PLGS_OT_cancel_split = base.cancels(SplitByViews, "Stop reading the masks. An object that is not split yet stays whole")

PLGS_OT_cancel_removal = base.cancels(RemoveObjects, "Stop removing objects. Nothing is then changed")
