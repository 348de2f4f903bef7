"""An engine that makes what Blender cannot of a scene's frames: one process, polled; then its files are shown.

What it belongs to is found again by its lift's key, so that undo, another file or a removed camera do no harm: then
nothing is shown.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...engine.job import ExitCode, JobError
from ...engine.job.made_frames import made_of
from ...engine.job.process import EngineProcess, engine_call
from ..errors import EXPECTED
from ..frame_pictures import show_made
from ..import_scene import add_made, place_scene
from ..inspecting.lookup import objects_by_key
from ..lift_collection import lifts_in
from ..made_pictures import frames_folder
from ..owned import LIFT
from ..scene_survey import Place

_GLANCE_S = 0.05


@dataclass(frozen=True)
class Order:
    """What is made, for whom: the lift's key, the ``kinds`` as the engine's command calls them, and, where it is for
    one camera's view, its ``frame`` and ``what`` is to be shown there. Without a lift the whole import waits for the
    engine: then ``scene`` names Blender's scene that it goes into.
    """

    place: Place
    lift: str
    kinds: tuple[str, ...]
    frame: str = ""
    what: str = ""
    scene: str = ""


@dataclass(frozen=True, eq=False)
class _Making:
    order: Order
    folder: Path
    process: EngineProcess


_now: _Making | None = None
_progress: tuple[int, int] | None = None
_error: str | None = None
_failed: Order | None = None


def begin(order: Order, python: Path) -> None:
    """Start an engine. Raises JobError when one is at it already, or cannot be started."""
    global _now, _error
    if _now is not None:
        fix = "Wait until it is done, or cancel it."
        raise JobError("an engine makes frames already", _now.order.place.scene, fix)
    folder = frames_folder(order.place.resolved)
    command = [*engine_call(python), "frames", *order.place.arguments(), "-o", folder]
    command += ["--stay-with-parent", "--make", *order.kinds]
    if order.frame:
        command += ["--frames", order.frame]
    _error = None
    _now = _Making(order, folder, EngineProcess(command))


def is_making() -> bool:
    """Whether an engine makes frames just now."""
    return _now is not None


def progress() -> tuple[int, int] | None:
    """Frames done and their number, as of the last `poll`; None while that is not known. Looks at no disk."""
    return _progress


def error() -> str | None:
    """Why the last time ended badly; None when it did not, and after a cancel."""
    return _error


def error_for(place: Place | None, lift: str) -> str | None:
    """`error`, where it is of this scene, or of the lift or import of this key."""
    if _failed is None or (_failed.place != place and (not lift or _failed.lift != lift)):
        return None
    return _error


def poll() -> bool:
    """Show what was made when it is done; whether something ended."""
    global _error, _failed, _progress
    if _now is None:
        return False
    code, output = _now.process.exit_code(), _now.process.output_tail()
    if code is None:
        _progress = _progress_in(output)
        return False
    making = _now
    _failed = making.order
    stop()
    if code != ExitCode.FINISHED:
        last = output.splitlines()[-1] if output else f"the engine ended with {code}"
        _error = last.removeprefix("error: ")
    if code in (ExitCode.FINISHED, ExitCode.BAD_INPUT):  # of bad depth the pictures are made all the same
        try:
            _show(making)
        except EXPECTED as problem:
            _error = _error or str(problem)
    return True


def wait() -> None:
    """Wait until it is done, for scripts; `error` says how it ended."""
    try:
        while _now is not None and not poll():
            time.sleep(_GLANCE_S)
    except KeyboardInterrupt:
        stop()
        raise


def stop() -> None:
    """End the engine, if one is at it. What it made so far is kept."""
    global _now, _progress
    _progress = None
    if _now is not None:
        _now.process.kill()
        _now.process.close()
        _now = None


def forget() -> None:
    """Stop, and forget how the last time ended."""
    global _error
    stop()
    _error = None


def _progress_in(output: str) -> tuple[int, int] | None:
    """What the last line of the engine's output says."""
    lines = output.splitlines()
    if not lines or not lines[-1].startswith("frames "):
        return None
    done, _, total = lines[-1].removeprefix("frames ").partition("/")
    return (int(done), int(total)) if done.isdecimal() and total.isdecimal() else None


def _show(making: _Making) -> None:
    """Into every scene that has the import. Raises JobError or SceneError."""
    made, order = made_of(making.folder, making.order.place.resolved), making.order
    if made is None:
        return
    if not order.lift:
        scene = bpy.data.scenes.get(order.scene)
        if scene is not None:
            place_scene(order.place, scene, cloud="cloud" in order.kinds)
        return
    for scene in bpy.data.scenes:
        for root in lifts_in(scene):
            if root[LIFT] != order.lift:
                continue
            if not order.frame:
                add_made(scene, root, made)
                continue
            ob = objects_by_key(root).get(f"frame:{order.frame}")
            if ob is not None and order.frame in made.frames:
                show_made(scene, ob, order.what, made.frames[order.frame])
