"""What goes on with the engine in this Blender: one question to it, one set-up, and what came of them.

A timer of Blender's polls both (`tick`); a script without a window waits (`wait`). All of it survives undo and the
opening of another file, for it is kept here and not in the .blend.
"""

from __future__ import annotations

import atexit
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...engine.job import JobError
from ...engine.job.environment import environments_folder
from ...engine.job.lock import is_locked
from ...engine.job.log_tail import last_lines
from ...engine.job.process import ROOT, ChildProcess, ChosenPython, choose_python, clean_environment
from ..redrawing import redraw_panels
from .choices import choose, chosen_python
from .engine_status import UNKNOWN, EngineStatus, checking, status_of, without_python
from .handshake import Handshake
from .progress import Progress, Wish
from .set_up import LOCK, LOG, SetUp
from .trash import delete_command, throw_away, thrown_away

TICK_S = 0.1
_FIRST_CHECK_S = 0.5
_LOOK_AT_LOG_S = 1.0
_LOG_LINES = 8
OFFLINE_FIX = "Allow online access in Preferences > System."


@dataclass
class _Session:
    status: EngineStatus = UNKNOWN
    choice: ChosenPython | None = None
    handshake: Handshake | None = None
    set_up: SetUp | None = None
    error: JobError | None = None
    log_lines: tuple[str, ...] = ()
    log_seen_at: float = 0.0
    deletion: ChildProcess | None = None


_now = _Session()


def status() -> EngineStatus:
    """What is known of the engine. Looks at no disk."""
    return _now.status


def progress() -> Progress | None:
    """Of the set-up that goes on; None when none does."""
    return _now.set_up.progress if _now.set_up is not None else None


def set_up_error() -> JobError | None:
    """Why the last set-up failed; None when it did not."""
    return _now.error


def log_lines() -> tuple[str, ...]:
    """The last lines of the set-up's log, about a second old."""
    return _now.log_lines


def log_path() -> Path:
    """The set-up's log; it may be missing."""
    return environments_folder() / LOG


def check() -> None:
    """Ask the Python that is chosen now. What comes of it is in `status` a moment later."""
    _stop_asking()
    try:
        _now.choice = choose_python(ROOT, os.environ, chosen_python())
    except JobError as error:
        _now.status = without_python(error)
        redraw_panels()
        return
    _now.status = checking(_now.choice)
    _now.handshake = Handshake(_now.choice.python)
    _begin()


def why_no_set_up() -> str | None:
    """Why the engine cannot be set up now; None when it can. Looks at no disk."""
    if _now.set_up is not None:
        return "The engine is being set up already"
    return None if bpy.app.online_access else f"Packages have to be downloaded. {OFFLINE_FIX}"


def start_set_up(wish: Wish) -> None:
    """Begin to make the engine's environment, or go on with it. Raises JobError."""
    reason = why_no_set_up()
    if reason is not None:
        raise JobError("the engine cannot be set up now", "Set up engine", reason)
    _now.error, _now.log_lines = None, ()
    _now.set_up = SetUp(wish)
    _begin()


def cancel_set_up() -> None:
    """End the set-up at once; the next one goes on where it was."""
    if _now.set_up is not None:
        _now.set_up.cancel()
        _pump_set_up()


def remove() -> None:
    """Delete all environments that "Set up engine" made, and nothing else. Raises JobError, OSError.

    They are gone from their places when this returns; the disk is free some seconds later.
    """
    folder = environments_folder()
    if _now.set_up is not None or is_locked(folder / LOCK):
        raise JobError("the engine is being set up", folder, "Wait until it is done, or cancel it.")
    for environment in sorted(folder.glob("engine-*")):
        if (environment / "pyvenv.cfg").is_file():
            throw_away(environment, folder)
    if trash := thrown_away(folder):
        with (folder / LOG).open("ab") as log:
            command = delete_command(trash)
            _now.deletion = ChildProcess(command, cwd=folder, environment=clean_environment(), output=log)
    check()


def pump() -> bool:
    """Poll what goes on once; whether anything still does."""
    _pump_handshake()
    _pump_set_up()
    if _now.deletion is not None and _now.deletion.exit_code() is not None:
        _now.deletion = None
    return _now.handshake is not None or _now.set_up is not None or _now.deletion is not None


def wait(tell: Callable[[str], object] = lambda line: None) -> None:
    """Wait until nothing goes on any more, for scripts; each new step of a set-up is told."""
    told = None
    try:
        while pump():
            step = progress()
            if step is not None and (step.step, step.label) != told:
                told = (step.step, step.label)
                tell(f"{step.step}/{step.steps} {step.label}")
            time.sleep(TICK_S / 2)
    except KeyboardInterrupt:
        cancel_set_up()
        raise


def tick() -> float | None:
    """One call of the timer; the seconds until the next, None when there is nothing left to poll."""
    before = (_now.status, progress())
    goes_on = pump()
    if before != (_now.status, progress()):
        redraw_panels()
    return TICK_S if goes_on else None


def register() -> None:
    """Ask the engine a moment from now: while extensions are switched on there may be no preferences."""
    atexit.register(_end_programs)
    if not bpy.app.background:
        bpy.app.timers.register(_first_check, first_interval=_FIRST_CHECK_S, persistent=True)


def unregister() -> None:
    """Stop: a set-up ends, and can be gone on with."""
    global _now
    atexit.unregister(_end_programs)
    for timer in (tick, _first_check):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    _end_programs()
    _now = _Session()


def _first_check() -> None:
    check()


def _begin() -> None:
    """Start the timer. Without a window there is none: then somebody waits."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=TICK_S, persistent=True)


def _pump_handshake() -> None:
    if _now.handshake is None:
        return
    answer = _now.handshake.poll()
    if answer is not None:
        assert _now.choice is not None
        _now.status = status_of(_now.choice, answer)
        _stop_asking()


def _pump_set_up() -> None:
    set_up = _now.set_up
    if set_up is None:
        return
    if not bpy.app.online_access:
        set_up.cancel()
        _now.error = JobError("online access was switched off", "Set up engine", OFFLINE_FIX)
    set_up.poll()
    is_over = set_up.outcome is not None
    if is_over or time.monotonic() - _now.log_seen_at > _LOOK_AT_LOG_S:
        _now.log_lines, _now.log_seen_at = last_lines(set_up.log_path, _LOG_LINES), time.monotonic()
    if set_up.outcome is not None:
        _now.set_up, _now.error = None, set_up.outcome.error or _now.error
        if set_up.outcome.python is not None:
            choose(None)  # who sets the engine up wants that one
        check()


def _stop_asking() -> None:
    if _now.handshake is not None:
        _now.handshake.close()
        _now.handshake = None


def _end_programs() -> None:
    """Also when Blender ends. Touches nothing of Blender's, which may be gone by then."""
    _stop_asking()
    if _now.set_up is not None:
        _now.set_up.cancel()
