"""An engine that makes masks for a scene: one process, polled by a timer of Blender's; the panel draws from here."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...engine.job import ExitCode, JobError
from ...engine.job.process import EngineProcess, engine_call
from ..paths import absolute
from ..redrawing import redraw_panels
from ..scene_survey import Place
from ..settings import place_of
from . import poll_timer

_TICK_S = 0.25


@dataclass(frozen=True, eq=False)
class _Making:
    place: Place
    process: EngineProcess


_now: _Making | None = None
_error: str | None = None
_failed: Place | None = None
_line = ""


def begin(place: Place, python: Path, model: str, *, download: bool) -> None:
    """Start an engine. ``model``: a folder, or a name on Hugging Face's hub; empty: the engine's own choice.
    ``download``: whether it may fetch that. Raises JobError when one is at it already, or cannot be started.
    """
    global _now, _error, _line
    if _now is not None:
        raise JobError("an engine makes masks already", _now.place.scene, "Wait until it is done, or cancel it.")
    if model and absolute(model).is_dir():  # the engine's working folder is not Blender's
        model = str(absolute(model))
    command = [*engine_call(python), "segment", place.scene, f"--up={place.up}"]
    command += [] if place.scene_format is None else ["--format", place.scene_format]
    command += ["--stay-with-parent", *(["--model", model] if model else []), *(["--download"] if download else [])]
    _error, _line = None, "Making masks"
    _now = _Making(place, EngineProcess(command))
    if not bpy.app.background and not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=_TICK_S, persistent=True)


def is_making() -> bool:
    """Whether an engine makes masks just now."""
    return _now is not None


def progress() -> str:
    """What the engine said last, such as "Making masks  3/9  1:20 left"."""
    return _line


def error() -> str | None:
    """Why the last time ended badly; None when it did not, and after a cancel."""
    return _error


def error_for(place: Place) -> str | None:
    """`error`, where it is of this scene."""
    return _error if place == _failed else None


def poll() -> bool:
    """Learn how far it is; whether it goes on."""
    global _error, _failed, _line
    if _now is None:
        return False
    code, output, place = _now.process.exit_code(), _now.process.output_tail(), _now.place
    _line = output.splitlines()[-1] if output else _line
    if code is None:
        return True
    stop()
    if code == ExitCode.FINISHED:
        settings = bpy.context.scene.plgs
        if settings.scene_folder and place_of(settings) == place:  # another scene's survey stays
            poll_timer.look_at_scene(place)
    else:
        _error, _failed = _line.removeprefix("error: ") or f"the engine ended with exit code {code}", place
    return False


def wait() -> None:
    """Wait until it is done, for scripts. Raises JobError when it ended badly."""
    place = None if _now is None else _now.place
    try:
        while poll():
            time.sleep(_TICK_S)
    except KeyboardInterrupt:
        stop()
        raise
    if _error is not None and place is not None:
        raise JobError(f"masks could not be made ({_error})", place.scene, "Mend it, then make them again.")


def stop() -> None:
    """End the engine, if one is at it. What it made so far is kept, and the next time goes on."""
    global _now
    if _now is not None:
        _now.process.kill()
        _now.process.close()
        _now = None


def _tick() -> float | None:
    goes_on = poll()
    redraw_panels()
    return _TICK_S if goes_on else None


def unregister() -> None:
    """Stop, and forget how the last time ended."""
    global _error
    stop()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    _error = None
