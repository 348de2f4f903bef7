"""A whole lift from a command line: folder, engine, live line, and what to tell at the end."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from ..gates import printable
from .errors import JobError
from .exit_code import ExitCode
from .folder import LiftFolder, LiftState
from .follower import LiftFollower
from .options import request_from, resumable
from .process import engine_command, engine_python
from .request import LiftRequest
from .terminal import Interrupts, LiveLine, follow

_ENDING_S = 2.0
"""What an engine whose parent was killed may need to end."""


def lift_in_terminal(
    options: argparse.Namespace, interrupts: Interrupts, check: Callable[[LiftRequest], object]
) -> tuple[LiftFolder, ExitCode]:
    """Lift as the options of `add_lift_options`, ``scene``, ``output`` and ``resume`` ask, showing it on stderr.

    ``check`` looks at the scene before any folder is made, and raises when it is bad. A folder that was made here
    and came to nothing is removed, so that the corrected command just works. Raises JobError; Interrupted on
    Ctrl-C, when the engine has ended.
    """
    python = engine_python()
    lift = resumable(options)
    is_new = lift is None
    if lift is None:
        request = request_from(options)
        check(request)
        lift = LiftFolder.create(options.output, request)
    elif _state_when_left_alone(lift) is LiftState.FINISHED and lift.is_whole():
        print(f"This lift is finished already: {lift.path}", file=sys.stderr)
        return lift, ExitCode.FINISHED
    try:
        code = _run(lift, interrupts, python, resume=not is_new)
    finally:
        if is_new and _came_to_nothing(lift):
            lift.discard()
    return lift, code


def _state_when_left_alone(lift: LiftFolder) -> LiftState:
    """The state of a lift that nobody works on. Raises JobError when an engine still does after two seconds.

    Before one is started in vain: Ctrl-C would make a cancel file, and that would stop the other one.
    """
    give_up = time.monotonic() + _ENDING_S
    while (state := lift.state()) is LiftState.RUNNING:
        if time.monotonic() > give_up:
            fix = "Wait until it is done, or stop it by making a file named 'cancel' there."
            raise JobError("another engine is at work here", lift.path, fix)
        time.sleep(0.05)
    return state


def _run(lift: LiftFolder, interrupts: Interrupts, python: Path, *, resume: bool) -> ExitCode:
    with interrupts.deferred():
        follower = LiftFollower.start(lift, resume=resume, command=engine_command(python, lift.path, resume=resume))
        outcome = follow(follower, interrupts, LiveLine(sys.stderr))
    if outcome.error is not None:
        print(printable(f"error: {outcome.error}"), file=sys.stderr)
    elif outcome.code is ExitCode.CANCELLED:
        print(f"Cancelled. Give the same command with --resume to go on: {lift.path}", file=sys.stderr)
    return outcome.code


def _came_to_nothing(lift: LiftFolder) -> bool:
    """No engine got as far as a checkpoint: it never started, or refused the input."""
    if lift.is_running or lift.checkpoints.exists:
        return False
    state = lift.state_at_rest()
    return state is LiftState.NOT_STARTED or (state is LiftState.FAILED and lift.last_exit_code() == ExitCode.BAD_INPUT)
