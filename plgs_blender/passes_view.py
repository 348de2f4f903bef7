"""From a scene with a lift to the scene with its passes."""

from __future__ import annotations

import bpy

from ..engine.job import JobError
from .lift_collection import lifts_in
from .owned import LIFT, key_of, text_of
from .passes import show_view


def passes_scene_of(scene: bpy.types.Scene) -> bpy.types.Scene | None:
    """The passes scene of the first lift in the scene that has one; the scene itself when it is one."""
    if text_of(scene, LIFT) and key_of(scene, scene[LIFT]) == "passes":
        return scene
    for root in lifts_in(scene):
        for other in bpy.data.scenes:
            if key_of(other, root[LIFT]) == "passes":
                return other
    return None


def open_passes(scene: bpy.types.Scene) -> bpy.types.Scene:
    """The passes scene, brought to the view of the active camera where that was baked. Raises JobError."""
    passes = passes_scene_of(scene)
    if passes is None:
        raise JobError("has no passes", scene.name, "Bake them in the panel Passes.")
    camera = scene.camera
    frame = text_of(camera, "frame") if camera is not None else ""
    if frame in {marker.name for marker in passes.timeline_markers}:
        show_view(passes, frame)
    return passes
