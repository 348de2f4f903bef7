"""Mending what a lift got wrong: names, classes, and which points belong to which object."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatVectorProperty, IntProperty, StringProperty

from ..plgs_blender import corrections, painting
from ..plgs_blender.engine_environment import why_no_engine
from ..plgs_blender.errors import EXPECTED, PlgsError, one_line
from ..plgs_blender.inspecting import selection, views
from ..plgs_blender.inspecting.lookup import chosen_row, find_lift, row_of
from ..plgs_blender.painting import Painting
from ..plgs_blender.running.splitting import SplitByViews, split_by_views
from ..plgs_blender.tasks import registry
from ..plgs_blender.tasks.registry import Task
from ..plgs_blender.viewport import view_of
from .base import CANCELLED, FINISHED, PASSED_ON, RUNNING, StartsTask, panel_of, reporting, reporting_events
from .inspect import OnInstance, OnInstances, OnLift

_UNDOABLE = {"REGISTER", "UNDO"}
_STEP = 1.2
"""Factor by which the wheel changes the brush."""


def _class_choices(self: Any, context: bpy.types.Context, _text: str) -> list[str]:
    """The classes for a field of a dialog."""
    try:
        root = find_lift(context.scene, self.lift, context.active_object)
        row = chosen_row(context.scene, context.active_object)
        return corrections.class_choices(root, 0 if row is None else row.instance_id)
    except EXPECTED:  # while it is typed: the operator itself tells what is wrong
        return []


def _class_field() -> Any:
    return StringProperty(
        name="Class", search=_class_choices, options={"SKIP_SAVE"},
        description="Name of the class; those that the object's masks voted for come first",
    )  # fmt: skip


class AsksForOne:
    """An operator whose dialog asks for the property ``asked`` alone, ready to be typed. The others are for scripts."""

    asked: str
    layout: bpy.types.UILayout

    def draw(self, context: bpy.types.Context) -> None:
        field = self.layout.column()
        field.activate_init = True
        field.prop(self, self.asked)


class PLGS_OT_rename_instance(AsksForOne, OnInstance, bpy.types.Operator):
    """Give the object another name"""

    bl_idname, bl_label, bl_options = "plgs.rename_instance", "Rename Object", _UNDOABLE
    asked = "name"

    name: StringProperty(name="Name", options={"SKIP_SAVE"}, description="The name, up to 60 characters")  # type: ignore[valid-type]

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.name = row_of(self.root(context), self.instance).name
        return set(context.window_manager.invoke_props_dialog(self))

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        corrections.rename(root, row_of(root, self.instance).instance_id, self.name)
        return FINISHED


class PLGS_OT_reclass_instances(AsksForOne, OnInstances, bpy.types.Operator):
    """Give objects another class. With a class of stuff, which has no objects, their points become that stuff"""

    bl_idname, bl_label, bl_options = "plgs.reclass_instances", "Change Class", _UNDOABLE
    asked = "class_name"

    class_name: _class_field()  # type: ignore[valid-type]

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return set(context.window_manager.invoke_props_dialog(self))

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        numbers = corrections.chosen_instances(root, self.instances, context)
        corrections.reclass(root, numbers, self.class_name)
        return FINISHED


class PLGS_OT_merge_instances(OnInstances, bpy.types.Operator):
    """Let the selected objects be one, with the name and the class of the active one"""

    bl_idname, bl_label, bl_options = "plgs.merge_instances", "Merge Selected", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        corrections.merge(root, corrections.chosen_instances(root, self.instances, context))
        return FINISHED


class PLGS_OT_delete_instance(OnInstance, bpy.types.Operator):
    """Delete an object that is none"""

    bl_idname, bl_label, bl_options = "plgs.delete_instance", "Delete Object", _UNDOABLE

    becomes: EnumProperty(  # type: ignore[valid-type]
        name="Points become",
        items=[
            ("AROUND", "What Lies Around", "Each point takes the label of the nearest one of something else"),
            ("NO_OBJECT", "No Object", "They keep their class, without an object"),
        ],
    )

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        corrections.delete(root, row_of(root, self.instance).instance_id, around=self.becomes == "AROUND")
        return FINISHED


class PLGS_OT_split_instance(OnInstance, bpy.types.Operator):
    """Let an object be several"""

    bl_idname, bl_label, bl_options = "plgs.split_instance", "Split", _UNDOABLE

    by: EnumProperty(  # type: ignore[valid-type]
        name="By",
        options={"SKIP_SAVE"},
        items=[
            ("PARTS", "Connected Parts", "What does not touch; the largest part keeps the name"),
            ("CUT", "Cutting Plane", "The plane that Add Cutting Plane placed, where it was dragged to"),
            ("PLANE", "Plane", "The plane through a point, across a normal"),
        ],
    )
    point: FloatVectorProperty(name="Point", subtype="XYZ", options={"SKIP_SAVE"}, description="In the plane, metres")  # type: ignore[valid-type]
    normal: FloatVectorProperty(  # type: ignore[valid-type]
        name="Normal", subtype="XYZ", default=(1, 0, 0), options={"SKIP_SAVE"},
        description="Points to the side that becomes a new object",
    )  # fmt: skip

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        number = row_of(root, self.instance).instance_id
        if self.by == "CUT":
            edit = corrections.split_by_cut(root, number)
        elif self.by == "PLANE":
            edit = corrections.split_plane(root, number, (*self.point,), (*self.normal,))
        else:
            edit = corrections.split_parts(root, number)
        self.report({"INFO"}, one_line(f"New: {', '.join(one.name for one in edit.made)}"))
        return FINISHED


class PLGS_OT_split_by_views(OnInstance, StartsTask, bpy.types.Operator):
    """Split the object into what the masks of at least two frames show apart, each part of the class that they say"""

    bl_idname, bl_label = "plgs.split_by_views", "Split by Views"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str | None:
        if registry.running(SplitByViews):
            return "The engine is asking the masks already"
        # A script waits for the engine's answer; a button is grey until there is one.
        return super().why_not(context) or (why_no_engine() if panel_of(context) is not None else None)

    def begin(self, context: bpy.types.Context) -> Task:
        root = self.root(context)
        return split_by_views(root, row_of(root, self.instance).instance_id)


class PLGS_OT_place_cut(OnInstance, bpy.types.Operator):
    """Add a plane through the object, to be moved and turned to where it shall be split"""

    bl_idname, bl_label, bl_options = "plgs.place_cut", "Add Cutting Plane", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        corrections.place_cut(root, row_of(root, self.instance).instance_id)
        return FINISHED


class PLGS_OT_crop_instance(OnInstance, bpy.types.Operator):
    """Take the object's points anew from where its box was moved or scaled to: those of its class that the box holds"""

    bl_idname, bl_label, bl_options = "plgs.crop_instance", "Crop to Its Box", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        corrections.crop(root, row_of(root, self.instance).instance_id)
        return FINISHED


class PLGS_OT_accept_instances(OnInstances, bpy.types.Operator):
    """These objects are right: nothing proposes to change them again"""

    bl_idname, bl_label, bl_options = "plgs.accept_instances", "Accept", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        corrections.accept(root, corrections.chosen_instances(root, self.instances, context))
        return FINISHED


class PLGS_OT_undo_correction(OnLift, bpy.types.Operator):
    """Undo the last correction of this lift, also one from an earlier session or of another program"""

    bl_idname, bl_label, bl_options = "plgs.undo_correction", "Undo Last Correction", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        edit = corrections.undo_last(self.root(context))
        self.report({"INFO"}, f"Undone: {edit.kind}")
        return FINISHED


class PLGS_OT_assign_points(OnLift, bpy.types.Operator):
    """Paint points, or name an object whose box holds them, and give them to an object, a new object or a class"""

    bl_idname, bl_label, bl_options = "plgs.assign_points", "Paint Points", _UNDOABLE

    to: EnumProperty(  # type: ignore[valid-type]
        name="To",
        items=[
            ("INSTANCE", "Object", "The object that is selected in the list"),
            ("NEW", "New Object", "A new object of a class"),
            ("CLASS", "Class", "A class, without an object"),
        ],
    )
    instance: IntProperty(name="Instance", min=0, options={"SKIP_SAVE"}, description="Id; 0: the selected one")  # type: ignore[valid-type]
    class_name: _class_field()  # type: ignore[valid-type]
    region: StringProperty(  # type: ignore[valid-type]
        name="Region", options={"SKIP_SAVE"}, description="Name of an object whose box holds the points; empty: paint"
    )

    @reporting_events
    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.region:
            return self.execute(context)
        if context.area is None or context.area.type != "VIEW_3D":
            raise PlgsError("points are painted in a 3D view", "", "Press the button in a 3D view's sidebar.")
        root = self.root(context)
        if self.to == "INSTANCE":  # what is missing is told before anything is painted
            row_of(root, self.instance)
        else:
            corrections.class_named(root, self.class_name)
        painting.now[:] = [Painting.of(corrections.read_corrected(corrections.folder_of(root)).points.xyz)]
        context.window.cursor_modal_set("PAINT_BRUSH")
        context.window_manager.modal_handler_add(self)
        self._say(context)
        return RUNNING

    @reporting_events
    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not painting.now or context.area is None:  # another file was opened, or the view closed
            self.cancel(context)
            return CANCELLED
        now = painting.now[0]
        view = next(region for region in context.area.regions if region.type == "WINDOW")
        place = (float(event.mouse_x - view.x), float(event.mouse_y - view.y))
        context.area.tag_redraw()
        if event.type == "MOUSEMOVE":
            now.move(place)
        elif event.type == "LEFTMOUSE" and event.value == "PRESS" and _is_over(context.area, event):
            now.press(place, is_box=event.shift, is_eraser=event.ctrl)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE" and now.places:
            now.move(place)
            matrix = np.array(context.area.spaces.active.region_3d.perspective_matrix)
            now.release(matrix, (view.width, view.height))
        elif event.type in ("WHEELUPMOUSE", "WHEELDOWNMOUSE") and event.ctrl:
            now.radius *= _STEP if event.type == "WHEELUPMOUSE" else 1.0 / _STEP
            self._say(context)
        elif event.type in ("RET", "NUMPAD_ENTER") and event.value == "PRESS":
            self.cancel(context)
            self._assign(context, now.choose)
            return FINISHED
        elif event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return CANCELLED
        else:
            return PASSED_ON  # the view may be turned meanwhile, and the panel be used
        return RUNNING

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender calls this, too, where it ends the painting itself."""
        painting.now.clear()
        if context.window is not None:
            context.window.cursor_modal_restore()
        if context.area is not None:
            context.area.header_text_set(None)

    def _say(self, context: bpy.types.Context) -> None:
        line = "Drag: paint points; Shift: rectangle; Ctrl: take away; Ctrl wheel: brush; Enter: assign; Esc: leave"
        context.area.header_text_set(line)

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self._assign(context, corrections.in_region(self.region))
        return FINISHED

    def _assign(self, context: bpy.types.Context, choose: corrections.Choose) -> None:
        root = self.root(context)
        number = row_of(root, self.instance).instance_id if self.to == "INSTANCE" else 0
        corrections.assign(root, choose, number, self.class_name, is_new=self.to == "NEW")


def _is_over(area: bpy.types.Area, event: bpy.types.Event) -> bool:
    """Whether the mouse is over an area's view, not over a bar or the sidebar that covers it."""

    def holds(region: bpy.types.Region) -> bool:
        inside = 0 <= event.mouse_x - region.x < region.width and 0 <= event.mouse_y - region.y < region.height
        return inside and min(region.width, region.height) > 1

    return {region.type for region in area.regions if holds(region)} == {"WINDOW"}


class PLGS_OT_propose_corrections(OnLift, bpy.types.Operator):
    """Look for objects that are perhaps wrong: views disagree on the class, parts do not touch, few frames saw it"""

    bl_idname, bl_label, bl_options = "plgs.propose_corrections", "What May Be Wrong?", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        found = corrections.propose(self.root(context))
        self.report({"INFO"}, f"{len(found.open)} proposals, {found.progress}")
        return FINISHED


class OnProposal(OnLift):
    """An operator on what is proposed for an instance."""

    instance: IntProperty(  # type: ignore[valid-type]
        name="Instance", min=0, options={"SKIP_SAVE"}, description="Id of the instance; 0: the most doubtful"
    )


class PLGS_OT_go_to_proposal(OnProposal, bpy.types.Operator):
    """Select the object, and look at it from the frame that sees it best"""

    bl_idname, bl_label, bl_options = "plgs.go_to_proposal", "Look at It", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        one = corrections.proposal_of(root, self.instance)
        selection.select_instance(root, one.instance, context.view_layer)
        if one.frame:
            views.look_from_frame(root, one.frame, context.scene, view_of(context)[0])
        self.report({"INFO"}, one_line(f"{one.name}: {one.reason}"))
        return FINISHED


class PLGS_OT_answer_proposal(OnProposal, StartsTask, bpy.types.Operator):
    """Do what is proposed, or keep the object as it is"""

    bl_idname, bl_label, bl_options = "plgs.answer_proposal", "Answer", _UNDOABLE

    keep: BoolProperty(name="Keep", options={"SKIP_SAVE"}, description="It is right as it is")  # type: ignore[valid-type]

    def begin(self, context: bpy.types.Context) -> Task | None:
        root = self.root(context)
        one = corrections.proposal_of(root, self.instance)
        if one.answer == corrections.BY_VIEWS and not self.keep:
            return split_by_views(root, one.instance)
        corrections.answer(root, one.instance, keep=self.keep)
        return None


class PLGS_OT_next_uncertain_frame(OnLift, bpy.types.Operator):
    """Look from the frame in which the lift is the least sure of the classes, then from the next one"""

    bl_idname, bl_label, bl_options = "plgs.next_uncertain_frame", "Next Uncertain Frame", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        frame, visited, frames = corrections.next_uncertain(root)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])
        self.report({"INFO"}, f"Frame {one_line(frame)}, {visited} of {frames} looked at")
        return FINISHED


CLASSES = (
    PLGS_OT_next_uncertain_frame,
    PLGS_OT_propose_corrections,
    PLGS_OT_go_to_proposal,
    PLGS_OT_answer_proposal,
    PLGS_OT_rename_instance,
    PLGS_OT_reclass_instances,
    PLGS_OT_merge_instances,
    PLGS_OT_delete_instance,
    PLGS_OT_split_instance,
    PLGS_OT_split_by_views,
    PLGS_OT_place_cut,
    PLGS_OT_crop_instance,
    PLGS_OT_accept_instances,
    PLGS_OT_undo_correction,
    PLGS_OT_assign_points,
)
