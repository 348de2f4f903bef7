"""The frames of a scene in Blender before anything was lifted: to see whether poses, lenses and pictures fit."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..engine.scene import UpAxis, open_scene
from .frames import mark_timeline, place_frames
from .lift_collection import child_collection, overview_of, root_collection, scene_to_fill
from .owned import LIFT, OwnedDataBlocks


def place_scene(
    folder: Path, scene: bpy.types.Scene, *, masks: Path | None = None, up: UpAxis = "z"
) -> bpy.types.Collection:
    """Put one camera a frame, with its picture and timeline marker, into the scene; returns the collection.

    A lift of the same frames later fills the same collection; one that is there already keeps all else. Raises
    SceneError, before anything is changed.
    """
    opened = open_scene(folder, masks, up)
    scene = scene_to_fill(scene)
    root = root_collection(opened.folder, None, scene)
    owned = OwnedDataBlocks(root[LIFT], scene)
    cameras = place_frames(owned, child_collection(root, "Cameras"), opened.frames)
    mark_timeline(scene, root, root[LIFT], overview_of(root), cameras)
    if scene.camera is None:
        scene.camera = cameras[0]
    return root
