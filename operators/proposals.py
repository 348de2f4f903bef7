"""Looking for what may be wrong with a lift, and answering what is proposed."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, IntProperty

from ..plgs_blender import corrections, proposals
from ..plgs_blender.errors import one_line, plural
from ..plgs_blender.inspecting import selection, views
from ..plgs_blender.running.splitting import split_by_views
from ..plgs_blender.tasks.registry import Task
from ..plgs_blender.viewport import view_of
from .base import FINISHED, StartsTask, reporting
from .inspect import OnLift

_UNDOABLE = {"REGISTER", "UNDO"}


class PLGS_OT_propose_corrections(OnLift, bpy.types.Operator):
    """Find objects that may be wrong: views disagree on the class, parts do not touch, or few frames saw the object"""

    bl_idname, bl_label, bl_options = "plgs.propose_corrections", "What May Be Wrong?", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        found = proposals.propose(self.root(context))
        self.report({"INFO"}, f"{plural(len(found.open), 'proposal')}, {found.progress}")
        return FINISHED


class OnProposal(OnLift):
    """An operator on the proposal for an instance."""

    instance: IntProperty(  # type: ignore[valid-type]
        name="Instance", min=0, options={"SKIP_SAVE"}, description="Id of the instance; 0: the most doubtful one"
    )


class PLGS_OT_go_to_proposal(OnProposal, bpy.types.Operator):
    """Select the object, and look through the camera of the frame that sees it best"""

    bl_idname, bl_label, bl_options = "plgs.go_to_proposal", "Look at It", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        one = proposals.proposal_of(root, self.instance)
        selection.select_instance(root, one.instance, context.view_layer)
        if one.frame:
            views.look_from_frame(root, one.frame, context.scene, view_of(context)[0])
        self.report({"INFO"}, one_line(f"{one.name}: {one.reason}"))
        return FINISHED


class PLGS_OT_answer_proposal(OnProposal, StartsTask, bpy.types.Operator):
    """Apply the proposal, or keep the object as it is"""

    bl_idname, bl_label, bl_options = "plgs.answer_proposal", "Answer", _UNDOABLE

    keep: BoolProperty(name="Keep", options={"SKIP_SAVE"}, description="The object is correct as it is")  # type: ignore[valid-type]

    def begin(self, context: bpy.types.Context) -> Task | None:
        root = self.root(context)
        one = proposals.proposal_of(root, self.instance)
        if one.answer == corrections.BY_VIEWS and not self.keep:
            return split_by_views(root, one.instance)
        corrections.answer(root, one.instance, keep=self.keep)
        return None


class PLGS_OT_next_uncertain_frame(OnLift, bpy.types.Operator):
    """Go to the frame in which the lift is least sure of the classes; press again for the next one"""

    bl_idname, bl_label, bl_options = "plgs.next_uncertain_frame", "Next Uncertain Frame", _UNDOABLE

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        frame, visited, frames = proposals.next_uncertain(root)
        views.look_from_frame(root, frame, context.scene, view_of(context)[0])
        self.report({"INFO"}, f"Frame {one_line(frame)}, {visited} of {frames} looked at")
        return FINISHED


CLASSES = (
    PLGS_OT_next_uncertain_frame,
    PLGS_OT_propose_corrections,
    PLGS_OT_go_to_proposal,
    PLGS_OT_answer_proposal,
)
