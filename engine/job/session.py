"""A whole lift from a command line: folder, engine, live line, and the message at the end."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..errors import ExitCode, PlgsError
from ..json_file import Json
from .events import at_work
from .folder import LiftFolder, LiftState
from .follower import TaskFollower
from .options import request_from, resumable
from .process import engine_call, engine_command, engine_python
from .task import LIFT, TaskPlace, TaskState
from .terminal import Interrupts, LiveLine, follow

_ENDING_S = 2.0
"""Seconds that an engine whose parent was killed may need to end."""


def show_error(error: PlgsError) -> None:
    """Print an error on standard error."""
    print(f"error: {error}", file=sys.stderr)


def lift_in_terminal(
    options: argparse.Namespace,
    interrupts: Interrupts,
    on_error: Callable[[PlgsError], object] = show_error,
) -> tuple[LiftFolder, ExitCode]:
    """Lift as the options of `add_lift_options`, ``scene``, ``output`` and ``resume`` ask. Progress goes to stderr, and
    events to the descriptor ``echo`` if the options have one. ``on_error`` is called with why the engine failed.

    The engine checks the scene, and tells whether anything is left to do in a finished lift. A folder that was made
    here for nothing is removed, so that the corrected command works. If the options have a ``program``, that program
    does the lift (see `engine_call`). Raises PlgsError, and Interrupted on Ctrl-C after the engine has ended.
    """
    python = engine_python()
    if options.poses is not None:  # an engine finds them, unless an earlier one has
        options.scene = Path(str(ask_engine(python, interrupts, "poses", options.scene)["folder"]))
    lift = resumable(options)
    is_new, finished_at = lift is None, None
    if lift is None:
        try:
            lift = LiftFolder.create(options.output, request_from(options))
        except PlgsError:
            lift, is_new = resumable(options), False  # the same command may have been given twice at once
            if lift is None:
                raise
    elif _state_when_left_alone(lift) is LiftState.FINISHED:
        finished_at = lift.manifest_path.stat().st_mtime_ns
    lift.refuse_read_only()
    try:
        program = getattr(options, "program", "engine")
        command = engine_command(python, lift.path, resume=True, program=program)
        code = _run(lift, interrupts, command, getattr(options, "echo", None), on_error)
    finally:
        if is_new and lift.came_to_nothing():
            lift.discard()
    if code is ExitCode.FINISHED and finished_at == lift.manifest_path.stat().st_mtime_ns:
        print(f"This lift is finished already: {lift.path}", file=sys.stderr)
    return lift, code


def ask_engine(python: Path, interrupts: Interrupts, kind: str, *arguments: str | Path) -> Mapping[str, Json]:
    """Run the engine's command ``kind`` to its end, with progress on stderr, and return its answer. Raises PlgsError,
    Interrupted."""
    with interrupts.deferred():
        follower = TaskFollower.start([*engine_call(python), kind, *arguments], TaskPlace.temporary(), kind=kind)
        follow(follower, interrupts, LiveLine(sys.stderr))
    if follower.error is not None or follower.answer is None:
        raise follower.error or PlgsError("the engine gave no answer", kind, "Give the same command again.")
    return follower.answer


def _state_when_left_alone(lift: LiftFolder) -> LiftState:
    """The state of a lift that no engine works on. Raises PlgsError if one still does after two seconds.

    This is done before an engine is started in vain: on Ctrl-C its cancel file would stop the other engine.
    """
    give_up = time.monotonic() + _ENDING_S
    while (state := lift.state()) is LiftState.RUNNING:
        if time.monotonic() > give_up:
            raise at_work(lift.events_path)
        time.sleep(0.05)
    return state


def _run(
    lift: LiftFolder,
    interrupts: Interrupts,
    command: Sequence[str | Path],
    echo: int | None,
    on_error: Callable[[PlgsError], object],
) -> ExitCode:
    with interrupts.deferred():
        follower = TaskFollower.start(command, lift.place, kind=LIFT, lift=lift)
        follow(follower, interrupts, LiveLine(sys.stderr), echo)
    if follower.error is not None:
        on_error(follower.error)
    elif follower.state is TaskState.CANCELLED:
        print(f"Cancelled. Give the same command with --resume to continue: {lift.path}", file=sys.stderr)
    return follower.exit_code
