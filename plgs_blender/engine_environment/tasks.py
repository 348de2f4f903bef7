"""Checks which engine a Python has, sets the engine up, and removes it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job.environment import environments_folder
from ...engine.job.follower import TaskFollower
from ...engine.job.process import ROOT, ChosenPython, choose_python
from ...engine.job.task import last_lines
from .. import registry
from ..registry import Task, start_engine
from . import status as states
from .choices import SetUpChoice, choose, chosen_python, own_python
from .status import EngineStatus

PATIENCE_S = 60.0
"""Seconds within which a Python must answer: it takes tenths of a second, a few seconds from a cold disk, ten on a busy
machine."""
OFFLINE_FIX = "Allow online access in Preferences > System."
_FIRST_CHECK_S = 0.5
_LOG_NAME = "set-up.log"
_LOG_LINES = 8
_LOG_EVERY_S = 1.0

_status = states.UNKNOWN


def status() -> EngineStatus:
    """What is known about the engine. Never reads the disk."""
    return _status


class EngineCheck(Task):
    """Checks which engine a Python has."""

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
            _status = states.without_answer(self._choice)
        elif self.error is not None:
            _status = states.of_error(self._choice, self.error)
        else:
            _status = states.of_answer(self._choice, self.answer)


class SetUp(Task):
    """Makes the engine's environment. After a cancel, the next set-up continues where this one stopped."""

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
            choose(None)  # whoever sets up the engine wants to use that one
        check()
        if self._is_offline:
            raise PlgsError("offline", "online access was switched off", "Set Up Engine", OFFLINE_FIX)

    def let_go(self) -> None:
        """The engine ends within a second, after ending the programs it started."""
        self.follower.close()


class Removal(Task):
    """Deletes the environments that set-ups made."""

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
        _status = states.without_python(error)
        registry.redraw_panels()
        return None
    _status = states.checking(choice)
    try:
        return registry.begin(EngineCheck(choice, start_engine("handshake", choice.python)))
    except (PlgsError, OSError) as error:
        what, fix = (error.what, error.fix) if isinstance(error, PlgsError) else (str(error), "Try again.")
        _status = states.failed(choice, f"{what}: {choice.python}", fix)
        return None


def ask_chosen() -> EngineCheck | None:
    """`check` a newly chosen Python, and forget how the last set-up ended, which concerned the old one."""
    if running_set_up() is None:
        registry.forget(SetUp.kind)
    return check()


def running_set_up() -> SetUp | None:
    """The running set-up, or None."""
    return next(iter(registry.running(SetUp)), None)


def log_path() -> Path:
    """The path of the set-up's log, which may not exist."""
    return environments_folder() / _LOG_NAME


def why_no_set_up() -> str | None:
    """Why the engine cannot be set up now, or None if it can. Never reads the disk."""
    if running_set_up() is not None:
        return "The engine is already being set up"
    return None if bpy.app.online_access else f"Packages have to be downloaded. {OFFLINE_FIX}"


def set_up(choice: SetUpChoice) -> SetUp:
    """Start making the engine's environment, or continue it. Raises PlgsError, OSError."""
    reason = why_no_set_up()
    if reason is not None:
        raise PlgsError("set-up-refused", "the engine cannot be set up now", "Set Up Engine", reason)
    return registry.begin(SetUp(start_engine(
        "set-up", own_python(), environments_folder(), *choice.arguments(), variables=choice.variables()
    )))  # fmt: skip


def remove() -> Removal:
    """Delete all environments that "Set Up Engine" made, and nothing else. Raises PlgsError, OSError."""
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
    _status = states.UNKNOWN


def _first_check() -> None:
    check()
