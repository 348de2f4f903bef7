"""The panel's scene into Blender, and an engine that makes what Blender cannot read of its frames.

An engine's files are shown when it is done, in the import or lift with the same key: so undo, another file or a removed
camera do no harm. Where these are gone, nothing is shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import ErrorCode, PlgsError
from ...engine.job.follower import TaskFollower
from ...engine.job.made_frames import made_of
from .. import engine_environment
from ..chosen_scene import ChosenScene, lacks_package
from ..engine_environment import why_no_engine
from ..frame_pictures import KIND_OF, place_of_root, root_of, show_here, show_made, why_no_picture
from ..import_scene import MISSING, add_made, look_at_imported, place_scene
from ..inspecting.lookup import objects_by_key
from ..lift_collection import SCENE, is_same_place, lifts_in
from ..made_pictures import frames_folder, made_before
from ..owned import LIFT
from ..settings import chosen_scene
from ..startup_file import taking_over
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine

_NAMES = {"colour": "pictures", "cloud": "a coloured cloud"}


@dataclass(frozen=True)
class FrameOrder:
    """The files that an engine shall make of a scene, and where they are shown.

    ``kinds`` are as the engine's command calls them. ``lift`` is the key of the import or lift that they belong to;
    without one the whole import waits for the engine, and ``scene`` names Blender's scene that it goes into. With
    ``frame`` only that frame is made, and its picture ``shown_kind`` is shown before its camera's view.
    """

    chosen: ChosenScene
    lift: str
    kinds: tuple[str, ...]
    frame: str = ""
    shown_kind: str = ""
    scene: str = ""


class FrameMaking(Task):
    """An engine makes files of a scene's frames."""

    kind, label, cancel_operator = "frames", "Making frames", "plgs.cancel_frames"

    def __init__(self, order: FrameOrder, folder: Path, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.order = order
        self._folder = folder

    def done(self, scene: Any) -> None:
        is_of_bad_input = self.error is not None and self.error.code is ErrorCode.BAD_INPUT
        if not self.has_finished and not is_of_bad_input:  # of bad depth the pictures are made all the same
            return
        self.undo_step = "PLGS Frames"
        made, order = made_of(self._folder, self.order.chosen.resolved), self.order
        if made is None:
            return
        if not order.lift:
            target = bpy.data.scenes.get(order.scene)
            if target is not None:
                _place(order.chosen, target, "cloud" in order.kinds)
            return
        for each in bpy.data.scenes:
            for root in (root for root in lifts_in(each) if root[LIFT] == order.lift):
                if not order.frame:
                    add_made(each, root, made)
                    continue
                ob = objects_by_key(root).get(f"frame:{order.frame}")
                if ob is not None and order.frame in made.frames:
                    show_made(each, ob, order.shown_kind, made.frames[order.frame])

    def error_for(self, chosen: ChosenScene | None, lift: str) -> PlgsError | None:
        """Its error, where it is of this scene, or of the import or lift with this key."""
        is_of_it = self.order.chosen == chosen or (lift and self.order.lift == lift)
        return self.error if is_of_it else None


def make_frames(order: FrameOrder, python: Path) -> FrameMaking:
    """Start an engine. Raises PlgsError when one is at it already or cannot be started, OSError."""
    registry.refuse_second(FrameMaking)
    folder = frames_folder(order.chosen.resolved)
    command: list[str | Path] = [*order.chosen.arguments(), "-o", folder, "--make", *order.kinds]
    command += ["--frames", order.frame] if order.frame else []
    return timer.begin(FrameMaking(order, folder, start_engine("frames", python, *command)))


def _place(chosen: ChosenScene, scene: bpy.types.Scene, cloud: bool) -> bpy.types.Collection:
    """Place the scene. In an untouched startup file the views then look at it. Raises PlgsError."""
    with taking_over(scene) as is_untouched:
        root = place_scene(chosen, scene, cloud=cloud)
    if is_untouched:
        look_at_imported(root, scene)
    return root


def begin_import(scene: bpy.types.Scene, *, cloud: bool = True) -> FrameMaking | None:
    """Import the scene that the panel is set to, and let an engine begin with what is missing, where there is one. What
    Blender's Python cannot even open is imported as a whole when the engine is done.

    Returns the engine's task, None where none was started. Raises PlgsError, OSError.
    """
    if not scene.plgs.scene_folder:
        raise PlgsError("no scene is chosen", "Scene", "Choose a capture's folder or file.")
    chosen = chosen_scene(scene.plgs)
    python = None
    if not registry.running(FrameMaking):
        registry.forget(FrameMaking.kind)
        python = engine_environment.engine_python()
    try:
        root = _place(chosen, scene, cloud)
    except PlgsError as error:
        if python is None or not lacks_package(error):
            raise
        kinds = ("colour", "cloud") if cloud else ("colour",)
        return make_frames(FrameOrder(chosen, "", kinds, scene=scene.name), python)
    if root[MISSING] and python is not None:
        return make_frames(FrameOrder(chosen, root[LIFT], tuple(root[MISSING].split())), python)
    return None


def imported(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The collection of the scene that the panel is set to; None where it is not imported."""
    folder = chosen_scene(scene.plgs).scene
    return next((root for root in lifts_in(scene) if is_same_place(root.get(SCENE, ""), folder)), None)


def what_is_missing(root: bpy.types.Collection) -> str:
    """A line about what an engine would add to an import; empty where nothing is missing."""
    missing = [_NAMES[kind] for kind in root.get(MISSING, "").split()]
    if not missing:
        return ""
    return f"An engine would add {' and '.join(missing)}: {why_no_engine() or 'import again'}"


def show_picture(scene: bpy.types.Scene, shown_kind: str) -> FrameMaking | None:
    """Show the photo, depth or masks of the active camera's frame before its view. Where that takes an engine its task
    is returned, which shows it a moment later. Raises PlgsError, OSError.
    """
    reason = why_no_picture(scene)
    if reason is not None:
        raise PlgsError("the active camera is no frame's", scene.name, f"{reason}.")
    ob = scene.camera
    root = root_of(scene, ob)
    chosen = place_of_root(root)
    made = made_before(chosen.resolved)
    drawn = None if made is None else made.frames.get(ob["frame"])
    python = engine_environment.engine_python()
    try:
        if show_here(scene, ob, shown_kind, drawn):
            return None
    except PlgsError as error:  # also where Blender's Python lacks a package: an engine may have it
        if python is None or error.where == ob["frame"]:  # the frame itself has no depth or no mask
            raise
    if python is None and drawn is not None:
        show_made(scene, ob, shown_kind, drawn)
        return None
    order = FrameOrder(chosen, root[LIFT], (KIND_OF[shown_kind],), ob["frame"], shown_kind)
    return make_frames(order, python or engine_environment.usable_python())
