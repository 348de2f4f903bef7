"""Reusing a lift's objects: as collections and assets, and keyed visible in the frames that show them."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty

from ..plgs_blender import corrections, reuse
from ..plgs_blender.errors import one_line, plural
from .base import FINISHED, reporting
from .inspect import OnInstances


class PLGS_OT_make_objects(OnInstances, bpy.types.Operator):
    """Turn each selected object into one mesh in its own collection, to be moved and used elsewhere, with its points
    hidden under it. A hole is left where it stood"""

    bl_idname, bl_label, bl_options = "plgs.make_objects", "Make Objects", {"REGISTER", "UNDO"}

    as_assets: BoolProperty(  # type: ignore[valid-type]
        name="As Assets", options={"SKIP_SAVE"}, description="Mark them as assets, each with a preview picture"
    )

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        numbers = corrections.chosen_instances(root, self.instances, context)
        made = reuse.make_objects(root, numbers, as_assets=self.as_assets)
        self.report({"INFO"}, one_line(f"Made: {', '.join(each.name for each in made)}"))
        return FINISHED


class PLGS_OT_key_visibility(OnInstances, bpy.types.Operator):
    """Key the selected objects to be visible only in the timeline's frames whose masks show them"""

    bl_idname, bl_label, bl_options = "plgs.key_visibility", "Key Visibility", {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = self.root(context)
        numbers = corrections.chosen_instances(root, self.instances, context)
        keyed = reuse.key_visibility(root, numbers, context.scene)
        self.report({"INFO"}, plural(keyed, "object has keys", "objects have keys"))
        return FINISHED


CLASSES = (PLGS_OT_make_objects, PLGS_OT_key_visibility)
