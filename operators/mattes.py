"""The matte of the compositor, from the lists of the result."""

from __future__ import annotations

import bpy
from bpy.props import IntProperty

from ..plgs_blender import mattes
from .answers import FINISHED, reporting
from .inspect import OnInstance, OnLift


class PLGS_OT_matte_instance(OnInstance, bpy.types.Operator):
    """Let the matte of the passes' compositor be this instance"""

    bl_idname, bl_label, bl_options = "plgs.matte_instance", "Matte", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self.report({"INFO"}, f"The compositor's matte is {mattes.matte_instance(self.root(context), self.instance)}")
        return FINISHED


class PLGS_OT_matte_class(OnLift, bpy.types.Operator):
    """Let the matte of the passes' compositor be all of this class"""

    bl_idname, bl_label, bl_options = "plgs.matte_class", "Matte", {"REGISTER", "UNDO"}

    class_id: IntProperty(name="Class", min=0, options={"SKIP_SAVE"}, description="Id of the class")  # type: ignore[valid-type]

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        self.report({"INFO"}, f"The compositor's matte is {mattes.matte_class(self.root(context), self.class_id)}")
        return FINISHED


CLASSES = (PLGS_OT_matte_instance, PLGS_OT_matte_class)
