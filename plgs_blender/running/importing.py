"""Import the panel's scene into Blender, and show one kind of picture (photo, depth or masks) for all frames.

An engine makes what Blender cannot read. When it is done, its files are shown in the import or lift with the same key,
so undo, another file or a removed camera do no harm. A frame's picture is made once its camera has been the scene's for
a moment and nothing plays or renders: scrubbing stays fast, and a render keeps the pictures that it began with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import ErrorCode, PlgsError
from ...engine.job import LiftFolder
from ...engine.job.follower import TaskFollower
from ...engine.known_scene import MadeFrames, known_scene, made_of
from .. import engine_environment, frame_pictures, registry
from ..cameras import PHOTO, SHOWN, picture_of, show_photo
from ..chosen_scene import ChosenScene, absolute, needs_engine
from ..engine_environment import why_no_engine
from ..import_scene import MISSING, add_made, place_scene, room_of
from ..inspecting.selection import objects_by_key
from ..owned import FOLDER, LIFT, SCENE, OwnedDataBlocks, is_same_place, lifts_in, text_of
from ..registry import Task, start_engine
from ..settings import chosen_scene
from ..startup_file import taking_over
from ..viewport import areas_of, show_room

_NAMES = {"colour": "pictures", "cloud": "a coloured cloud"}


@dataclass(frozen=True)
class FrameOrder:
    """An order to an engine to make files of a scene's frames, and where to show them. ``kinds`` are as in the engine's
    command. ``lift`` is the key of an import or lift; without one, the engine first lists the cameras, which go into
    the Blender scene named ``scene``. With ``frame``, only that frame is made, and its picture ``shown_kind`` is shown.
    There is an undo step only if a user ``asked`` for it."""

    chosen: ChosenScene
    lift: str
    kinds: tuple[str, ...]
    frame: str = ""
    shown_kind: str = ""
    scene: str = ""
    asked: bool = True


class FrameMaking(Task):
    """A task in which an engine makes files of a scene's frames, as its `FrameOrder` says."""

    kind, label, cancel_operator = "frames", "Making frames", "plgs.cancel_frames"

    def __init__(self, order: FrameOrder, folder: Path, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.order = order
        self._folder = folder

    def watch(self, scenes: Sequence[Any], has_news: bool) -> bool:
        """Place the cameras once the engine has read them, while it makes pictures. Returns whether it placed them."""
        return not self.order.lift and self.is_running and self.progress.step > 0 and self._place_cameras()

    def _place_cameras(self) -> bool:
        """Place the cameras, if they are ready. Returns whether they were. Raises PlgsError for a damaged note."""
        made, target = made_of(self._folder, self.order.chosen.resolved), bpy.data.scenes.get(self.order.scene)
        if made is None or target is None:
            return False
        root = _place(self.order.chosen, target, made, "cloud" in self.order.kinds)
        self.order = replace(self.order, lift=root[LIFT])
        return True

    def done(self, scene: Any) -> None:
        is_of_bad_input = self.error is not None and self.error.code is ErrorCode.BAD_INPUT
        if not self.has_finished and not is_of_bad_input:  # pictures are made even if the depth is bad
            return
        self.undo_step = "PLGS Frames" if self.order.asked else ""
        if not self._folder.is_dir() or (not self.order.lift and not self._place_cameras()):
            return
        made, order = made_of(self._folder, self.order.chosen.resolved), self.order
        if made is None:
            return
        for each in bpy.data.scenes:
            for root in (root for root in lifts_in(each) if root[LIFT] == order.lift):
                if not order.frame:
                    add_made(each, root, made)
                    continue
                ob = objects_by_key(root).get(f"frame:{order.frame}")
                if ob is not None and order.frame in made.frames:
                    frame_pictures.show_made(each, ob, order.shown_kind, made.frames[order.frame])

    def error_for(self, chosen: ChosenScene | None, lift: str) -> PlgsError | None:
        """Return the task's error, if it concerns this scene, or the import or lift with this key; else None."""
        is_of_it = self.order.chosen == chosen or (lift and self.order.lift == lift)
        return self.error if is_of_it else None


def make_frames(order: FrameOrder, python: Path) -> FrameMaking:
    """Start an engine that makes the files. Raises PlgsError if one is at work or none can be started; OSError."""
    registry.refuse_second(FrameMaking)
    folder = frame_pictures.frames_folder(order.chosen.resolved)
    command: list[str | Path] = [*order.chosen.arguments(), "-o", folder, "--make", *order.kinds]
    command += ["--frames", order.frame] if order.frame else []
    return registry.begin(FrameMaking(order, folder, start_engine("frames", python, *command)))


def _place(chosen: ChosenScene, scene: bpy.types.Scene, made: MadeFrames | None, cloud: bool) -> bpy.types.Collection:
    """Place the scene. In an unchanged startup file, views then turn to it. Raises PlgsError if it is unreadable."""
    with taking_over(scene) as is_untouched:
        root = place_scene(chosen, scene, made, cloud=cloud)
    if is_untouched:
        show_room(areas_of(scene), *room_of(root, scene))
    return root


def begin_import(scene: bpy.types.Scene, *, cloud: bool = True) -> FrameMaking | None:
    """Import the panel's scene. Plain folders are placed at once, and an engine, if any, makes what is missing. Cameras
    of other layouts appear when the engine has read them. Returns the engine's task, None without one. Raises PlgsError
    for a bad scene; OSError."""
    if not scene.plgs.scene_folder:
        raise PlgsError("no-scene", "no scene is chosen", "Scene", "Choose a capture's folder or file.")
    chosen = chosen_scene(scene.plgs)
    python = None
    if not registry.running(FrameMaking):
        registry.forget(FrameMaking.kind)
        python = engine_environment.engine_python()
    is_plain = chosen.is_plain
    if not is_plain and python is not None:
        kinds = ("colour", "cloud") if cloud else ("colour",)
        return make_frames(FrameOrder(chosen, "", kinds, scene=scene.name), python)
    made = frame_pictures.made_before(chosen.resolved)
    if not is_plain and made is None:
        registry.refuse_second(FrameMaking)  # an engine may be there, but busy
        raise needs_engine(chosen)
    root = _place(chosen, scene, made, cloud)
    if root[MISSING] and python is not None:
        return make_frames(FrameOrder(chosen, root[LIFT], tuple(root[MISSING].split())), python)
    return None


def imported(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """Return the collection of the panel's scene, or None if it is not imported."""
    folder = chosen_scene(scene.plgs).scene
    return next((root for root in lifts_in(scene) if is_same_place(root.get(SCENE, ""), folder)), None)


def what_is_missing(root: bpy.types.Collection) -> str:
    """Return a line about what an engine would add to an import; "" if nothing is missing."""
    missing = " and ".join(_NAMES[kind] for kind in root.get(MISSING, "").split())
    return f"An engine would add {missing}: {why_no_engine() or 'import again'}" if missing else ""


def show_picture(scene: bpy.types.Scene, shown_kind: str, *, asked: bool = True) -> FrameMaking | None:
    """Show the photo, depth or masks of the active camera's frame in front of its view. If an engine must make the
    picture, return its task, which then shows it, with an undo step if a user ``asked``. Without an engine, an outdated
    picture is shown. Raises PlgsError without a frame's camera; OSError."""
    reason = frame_pictures.why_no_picture(scene)
    if reason is not None:
        raise PlgsError("other-camera", "the active camera is not a frame's", scene.name, f"{reason}.")
    ob = scene.camera
    root = frame_pictures.root_of(scene, ob)
    chosen = frame_pictures.place_of_root(root)
    made = frame_pictures.made_before(chosen.resolved)
    picture = _picture_file(root, ob["frame"], chosen, made) if shown_kind == PHOTO else None
    if picture is not None:
        show_photo(ob, OwnedDataBlocks(root[LIFT], scene), picture, asked=True)
        return None
    drawn = None if made is None else made.frames.get(ob["frame"])
    if made is not None and drawn is not None and frame_pictures.picture_file(drawn, shown_kind) is not None:
        is_current = shown_kind == frame_pictures.DEPTH and frame_pictures.is_depth_current(made, ob["frame"])
        if is_current or engine_environment.engine_python() is None:
            frame_pictures.show_made(scene, ob, shown_kind, drawn)
            return None
    order = FrameOrder(chosen, root[LIFT], (frame_pictures.KIND_OF[shown_kind],), ob["frame"], shown_kind, asked=asked)
    return make_frames(order, engine_environment.usable_python())


def _picture_file(root: bpy.types.Collection, name: str, chosen: ChosenScene, made: MadeFrames | None) -> Path | None:
    """Return the image file of a frame; None if an engine must make it. Raises PlgsError if the frame is gone."""
    if text_of(root, FOLDER):
        opened = known_scene(LiftFolder.open(absolute(root[FOLDER])))
    elif chosen.is_plain:
        opened = chosen.open_plain()
    elif made is not None:
        opened = frame_pictures.scene_of(made)
    else:
        return None
    frame = next((each for each in opened.frames if each.name == name), None)
    if frame is None:
        raise PlgsError("frame-gone", "is no longer a frame of the scene", name, "Import the scene again.")
    return picture_of(frame, frame_pictures.photos(made, [frame]))


_CHOSEN = "plgs_picture"
"""Property of an import's or lift's collection: the picture chosen for its cameras' views."""
_REST_S = 0.4  # seconds for which a camera must stay the scene's before its picture is made
_tried: list[tuple[str, str]] = []
"""The last requested camera and picture, which is not requested again if an engine could not make it."""


def choose_picture(scene: bpy.types.Scene, kind: str, *, asked: bool = True) -> FrameMaking | None:
    """Show one kind of picture before the active camera and, from now on, before each camera that becomes active.
    Returns what `show_picture` returns."""
    making = show_picture(scene, kind, asked=asked)
    frame_pictures.root_of(scene, scene.camera)[_CHOSEN] = kind
    _tried[:] = [(scene.camera.name, kind)]
    return making


def wanted(scene: bpy.types.Scene) -> str:
    """Return the kind of picture that the scene's camera should show but does not; "" if it shows what was chosen."""
    if frame_pictures.why_no_picture(scene) is not None:
        return ""
    try:
        kind = text_of(frame_pictures.root_of(scene, scene.camera), _CHOSEN)
    except PlgsError:  # the camera's collection is gone
        return ""
    is_tried = (scene.camera.name, kind) in _tried
    return "" if is_tried or kind == scene.camera.get(SHOWN, PHOTO) else kind


def catch_up() -> float | None:
    """Show the picture that the camera should show. Returns None or, while something else runs, the seconds to wait."""
    scene, windows = bpy.context.scene, bpy.context.window_manager.windows
    kind = wanted(scene)
    if not kind:
        return None
    is_moving = bpy.app.is_job_running("RENDER") or any(window.screen.is_animation_playing for window in windows)
    if is_moving or registry.running(FrameMaking):
        return _REST_S
    try:
        choose_picture(scene, kind, asked=False)
    except (PlgsError, OSError):  # the panel's buttons show what the camera shows, and pressing one says why
        frame_pictures.root_of(scene, scene.camera)[_CHOSEN] = text_of(scene.camera, SHOWN) or PHOTO
    return None


@bpy.app.handlers.persistent
def _on_change(scene: bpy.types.Scene, *_arguments: object) -> None:
    if bpy.app.is_job_running("RENDER") or not wanted(scene):
        return
    if bpy.app.timers.is_registered(catch_up):
        bpy.app.timers.unregister(catch_up)
    bpy.app.timers.register(catch_up, first_interval=_REST_S)  # anew at each change: the camera must stay so long


HANDLERS = () if bpy.app.background else (("depsgraph_update_post", _on_change), ("frame_change_post", _on_change))


def unregister() -> None:
    if bpy.app.timers.is_registered(catch_up):
        bpy.app.timers.unregister(catch_up)
    _tried.clear()
