"""Check which engine a Python has, set the engine up, and remove it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job.environment import environments_folder
from ...engine.job.follower import TaskFollower
from ...engine.job.handshake import TOO_OLD, VERSION, EngineAnswer
from ...engine.job.process import ROOT, ChosenPython, Origin, choose_python
from ...engine.job.task import last_lines
from .. import registry
from ..errors import sentence
from ..registry import Task, start_engine
from .choices import SetUpChoice, choose, chosen_python, own_python

PATIENCE_S = 60.0
"""Seconds within which a Python must answer; it takes ten on a busy computer."""
OFFLINE_FIX = "Allow online access in Preferences > System."
_FIRST_CHECK_S = 0.5
_LOG_NAME = "set-up.log"
_LOG_LINES = 8
_LOG_EVERY_S = 1.0

_SET_UP = "Press 'Set Up Engine' in Preferences > Add-ons > PLGS, or choose a Python there that has what it needs."


class EngineState(Enum):
    """How much is known about the engine."""

    UNKNOWN = "unknown"
    CHECKING = "checking"
    READY = "ready"
    MISSING = "missing"
    FAILED = "failed"


@dataclass(frozen=True)
class EngineStatus:
    """The engine's ``state``, a ``message`` about it for the user, and a ``fix`` if it is unusable. ``note`` warns of
    package versions that differ from the tested ones. ``answer`` is the answer of the engine in ``python``, or None."""

    state: EngineState
    message: str = ""
    fix: str = ""
    note: str = ""
    python: Path | None = None
    answer: EngineAnswer | None = None

    @property
    def is_usable(self) -> bool:
        """Whether the engine may be started: true unless it was found to be missing or broken."""
        return self.state not in (EngineState.MISSING, EngineState.FAILED)


_UNKNOWN = EngineStatus(EngineState.UNKNOWN, "The engine has not been checked yet", "Check the engine.")
_status = _UNKNOWN


def status() -> EngineStatus:
    """Return what is known about the engine. Never reads the disk."""
    return _status


when_ready: list[Callable[[], object]] = []
"""Called after an engine has answered that it can be used."""


class EngineCheck(Task):
    """A task that asks a Python which engine it has."""

    kind, label = "check", "Asking the engine"

    def __init__(self, choice: ChosenPython, follower: TaskFollower) -> None:
        super().__init__(follower)
        self._choice = choice
        self._is_hung = False

    def poll(self, scene: Any) -> bool:
        if self.is_running and not self._is_hung and time.monotonic() - self.began > PATIENCE_S:
            self._is_hung = True
            self.follower.kill()
        return super().poll(scene)

    def done(self, scene: Any) -> None:
        global _status
        if self._is_hung:
            fix = "Check the engine again, or choose another Python."
            _status = _failed(self._choice, f"{self._choice.python} did not answer", fix)
        elif self.error is None:
            _status = _of_answer(self._choice, self.answer)
        elif TOO_OLD in self.error.what:
            _status = _failed(self._choice, self.error.what, "Choose a newer Python, or set the engine up.")
        else:
            message = f"{self._choice.python} does not run the engine ({str(self.error)[:200]})"
            _status = _failed(self._choice, message, "Choose another Python, or set the engine up.")
        for listener in when_ready if _status.state is EngineState.READY else ():
            listener()


def _of_answer(choice: ChosenPython, answer: Mapping[str, Any] | None) -> EngineStatus:
    """Return the status after a Python answered; ``answer`` is None if it ended without one."""
    engine = EngineAnswer.from_json(answer or {})
    if engine is None:
        message = f"{choice.python} answers, but not as a Python with this engine should"
        return _failed(choice, message, "Choose another Python.")
    if engine.engine != VERSION:
        message = f"engine {engine.engine} does not match this PLGS, which is {VERSION}"
        return _failed(choice, message, "Restart Blender: PLGS was updated while Blender was running.")
    if engine.missing:
        message = f"{choice.python} ({choice.origin}) lacks {', '.join(engine.missing)}"
        fix = choice.fix if choice.origin is Origin.VARIABLE else _SET_UP
        return EngineStatus(EngineState.MISSING, message, fix, "", choice.python, engine)
    build = f"CUDA {engine.cuda}" if engine.cuda else "CPU"
    torch = (engine.packages["torch"] or "").partition("+")[0]
    cores = "1 core" if engine.cpus == 1 else f"{engine.cpus} cores"
    message = f"Engine {engine.engine}, Python {engine.python}, torch {torch} ({build}), {cores}"
    note = f"Versions that differ from the tested ones: {', '.join(engine.others)}" if engine.others else ""
    return EngineStatus(EngineState.READY, message, "", note, choice.python, engine)


def _failed(choice: ChosenPython, message: str, fix: str) -> EngineStatus:
    fix = fix if choice.origin is Origin.CHOSEN else f"{fix} {choice.fix}"
    return EngineStatus(EngineState.FAILED, sentence(message), fix, "", choice.python)


class SetUp(Task):
    """A task that makes the engine's environment. After a cancel, the next set-up continues where this one stopped."""

    kind, label, cancel_operator = "set-up", "Setting the engine up", "plgs.cancel_engine_set_up"
    counts_steps = False

    def __init__(self, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.log_lines: tuple[str, ...] = ()
        """The last lines of the log, up to a second old."""
        self._log_seen_at = 0.0
        self._is_offline = False

    def poll(self, scene: Any) -> bool:
        if self.is_running and not bpy.app.online_access and not self._is_offline:
            self._is_offline = True
            self.cancel()
        has_news = super().poll(scene)
        if not self.is_running or time.monotonic() - self._log_seen_at > _LOG_EVERY_S:
            self.log_lines, self._log_seen_at = last_lines(log_path(), _LOG_LINES), time.monotonic()
        return has_news

    def done(self, scene: Any) -> None:
        if self.has_finished:
            choose(None)  # use the environment just made
        check()
        if self._is_offline:
            raise PlgsError("offline", "online access was switched off", "Set Up Engine", OFFLINE_FIX)

    def let_go(self) -> None:
        """End the engine within a second, after the programs that it started."""
        self.follower.close()


class Removal(Task):
    kind, label = "removal", "Removing the engine"

    def done(self, scene: Any) -> None:
        check()


def check() -> EngineCheck | None:
    """Check the chosen Python in the background; `status` then has its answer. Returns None if no Python is chosen."""
    global _status
    registry.forget(EngineCheck.kind)
    try:
        choice = choose_python(ROOT, os.environ, chosen_python())
    except PlgsError as error:
        _status = EngineStatus(EngineState.MISSING, sentence(error.what), _SET_UP)
        registry.redraw_panels()
        return None
    _status = EngineStatus(EngineState.CHECKING, "Asking the engine", python=choice.python)
    try:
        return registry.begin(EngineCheck(choice, start_engine("handshake", choice.python)))
    except (PlgsError, OSError) as error:
        what, fix = (error.what, error.fix) if isinstance(error, PlgsError) else (str(error), "Try again.")
        _status = _failed(choice, f"{what}: {choice.python}", fix)
        return None


def ask_chosen() -> EngineCheck | None:
    """Check a newly chosen Python; forget how the last set-up ended. Returns None if no Python is chosen."""
    if running_set_up() is None:
        registry.forget(SetUp.kind)
    return check()


def running_set_up() -> SetUp | None:
    """Return the running set-up, None if none runs."""
    return next(iter(registry.running(SetUp)), None)


def log_path() -> Path:
    """Return the path of the set-up's log, which may not exist."""
    return environments_folder() / _LOG_NAME


def why_no_set_up() -> str | None:
    """Return why the engine cannot be set up now, or None if it can. Never reads the disk."""
    if running_set_up() is not None:
        return "The engine is already being set up"
    return None if bpy.app.online_access else f"Packages have to be downloaded. {OFFLINE_FIX}"


def set_up(choice: SetUpChoice) -> SetUp:
    """Start, or continue, making an environment. Raises PlgsError if a set-up runs or Blender is offline; OSError."""
    reason = why_no_set_up()
    if reason is not None:
        raise PlgsError("set-up-refused", "the engine cannot be set up now", "Set Up Engine", reason)
    arguments = environments_folder(), *choice.arguments()
    return registry.begin(SetUp(start_engine("set-up", own_python(), *arguments, variables=choice.variables())))


def remove() -> Removal:
    """Delete all environments that "Set Up Engine" made, and nothing else. Raises PlgsError during a set-up;
    OSError."""
    if running_set_up() is not None:
        what = "the engine is being set up"
        raise PlgsError("being-set-up", what, environments_folder(), "Wait until it is done, or cancel it.")
    return registry.begin(Removal(start_engine("set-up", own_python(), environments_folder(), "--remove")))


def register() -> None:
    """Check the engine a moment later, as preferences may not exist yet while extensions are enabled."""
    if not bpy.app.background:
        bpy.app.timers.register(_first_check, first_interval=_FIRST_CHECK_S, persistent=True)


def unregister() -> None:
    global _status
    if bpy.app.timers.is_registered(_first_check):
        bpy.app.timers.unregister(_first_check)
    for kind in (EngineCheck, SetUp, Removal):
        registry.forget(kind.kind)
    _status = _UNKNOWN


def _first_check() -> None:
    check()
