"""From what the panel says to an imported scene, with an engine for what Blender cannot make of it."""

from __future__ import annotations

import bpy

from ...engine.job import JobError
from ...engine.scene import SceneError
from .. import engine_environment
from ..frame_pictures import KIND_OF, place_of_root, root_of, show_here, show_made, why_no_picture
from ..import_scene import MISSING, place_scene
from ..lift_collection import SCENE, is_same_place, lifts_in
from ..made_pictures import made_before
from ..owned import LIFT
from ..scene_survey import lacks_package
from ..settings import place_of
from . import frame_making
from .frame_making import Order
from .start import why_no_engine

_NAMES = {"colour": "pictures", "cloud": "a coloured cloud"}


def begin_import(scene: bpy.types.Scene, *, cloud: bool = True) -> None:
    """Import the scene that the panel is set to, and let an engine begin with what is missing, where there is one. What
    Blender's Python cannot even open comes as a whole when the engine is done.

    Raises SceneError or JobError.
    """
    if not scene.plgs.scene_folder:
        raise JobError("no scene is chosen", "Scene", "Choose a capture's folder or file.")
    place = place_of(scene.plgs)
    python = None
    if not frame_making.is_making():
        frame_making.forget()
        python = engine_environment.engine_python()
    try:
        root = place_scene(place, scene, cloud=cloud)
    except SceneError as error:
        if python is None or not lacks_package(error):
            raise
        kinds = ("colour", "cloud") if cloud else ("colour",)
        frame_making.begin(Order(place, "", kinds, scene=scene.name), python)
        return
    if root[MISSING] and python is not None:
        frame_making.begin(Order(place, root[LIFT], tuple(root[MISSING].split())), python)


def imported(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The collection of the scene that the panel is set to; None where it is not imported."""
    folder = place_of(scene.plgs).scene
    return next((root for root in lifts_in(scene) if is_same_place(root.get(SCENE, ""), folder)), None)


def what_is_missing(root: bpy.types.Collection) -> str:
    """A line about what an engine would add to an import; empty where nothing is missing."""
    missing = [_NAMES[kind] for kind in root.get(MISSING, "").split()]
    if not missing:
        return ""
    return f"An engine would add {' and '.join(missing)}: {why_no_engine() or 'import again'}"


def show_picture(scene: bpy.types.Scene, what: str) -> bool:
    """Show the photo, depth or masks of the active camera's frame before its view; False where an engine was started
    for it, which shows it a moment later. Raises JobError or SceneError.
    """
    reason = why_no_picture(scene)
    if reason is not None:
        raise JobError("the active camera is no frame's", scene.name, f"{reason}.")
    ob = scene.camera
    root = root_of(scene, ob)
    place = place_of_root(root)
    made = made_before(place.resolved)
    drawn = None if made is None else made.frames.get(ob["frame"])
    python = engine_environment.engine_python()
    try:
        if show_here(scene, ob, what, drawn):
            return True
    except SceneError:  # also where Blender's Python lacks a package: an engine may have it, or says the same
        if python is None:
            raise
    if python is None and drawn is not None:
        show_made(scene, ob, what, drawn)
        return True
    python = python or engine_environment.usable_python()
    frame_making.begin(Order(place, root[LIFT], (KIND_OF[what],), ob["frame"], what), python)
    return False
