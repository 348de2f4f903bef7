"""One run of the engine in a lift folder, from the lock to the exit code."""

from __future__ import annotations

import errno
import logging
import os
import platform
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Protocol, TextIO

from ..gates import printable
from ..job import Cancelled, EventWriter, ExitCode, JobError, LiftFolder, LiftState, StopSignal, Watchdog, verify_lifted
from ..job.folder import BAKE
from ..job.recent import remember_lift
from ..scene import SceneError
from .log_output import output_to

log = logging.getLogger("plgs.engine")


class Lift(Protocol):
    """The work itself: it ends by writing the manifest, or by raising."""

    def __call__(self, folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None: ...


@dataclass(frozen=True)
class Task:
    """What an engine does in a folder, and what somebody is told whose engine did not get to its end."""

    work: Callable[[EventWriter, StopSignal], object]
    resumed: bool
    name: str | None = None  # None: a lift
    when_stopped: str = "Give the same command with --resume to go on"
    again: str = "resume"
    with_less_memory: str = "Resume after closing other programs, or lift anew with a smaller --size."


def run_engine(
    folder: LiftFolder, *, resume: bool = False, parent_pipe: int | None = None, lift: Lift | None = None
) -> ExitCode:
    """Lift, and answer how it ended. ``parent_pipe``: see Watchdog. ``lift``: what to run instead of `run_lift`.

    Raises JobError before anything is changed: another engine is at work, or the folder was used and ``resume`` is
    not given. Later every error is an event, a line on standard error and an exit code.
    """
    folder.refuse_foreign()
    with folder.lock():
        if not (folder.path / "request.json").exists():
            raise JobError("was removed meanwhile", folder.path, "Lift the scene again.")
        state = folder.state_at_rest()
        if state is LiftState.FINISHED and resume and folder.is_whole():
            print(f"This lift is finished already: {folder.result_path}")
            return ExitCode.FINISHED
        if state is not LiftState.NOT_STARTED and not resume:
            fix = "Choose another folder." if state is LiftState.FINISHED else "Add --resume to go on with it."
            raise JobError(f"holds a lift that was begun before ({state.value})", folder.path, fix)
        with output_to(folder.log_path) as terminal:
            if resume:
                folder.prepare_run()

            def work(events: EventWriter, stop: StopSignal) -> None:
                (lift or _run_lift())(folder, events, stop, resume=resume)

            return _run(folder, Task(work, resumed=resume and folder.checkpoints.exists), parent_pipe, terminal)


def run_bake(
    folder: LiftFolder,
    frames: Sequence[str] | None,
    *,
    cameras: Path | None = None,
    parent_pipe: int | None = None,
    events_path: Path | None = None,
) -> ExitCode:
    """Bake more of a finished lift, frames ("test", "all", or their names) or the cameras of a file, and answer how it
    ended.

    Whatever happens the lift stays finished, and what was baked before stays. Where another process bakes already this
    one bakes beside it, without a place in the lift's events: unless it is to be followed, by ``parent_pipe``. With
    ``events_path`` it bakes beside in any case, and is followed there. Otherwise as `run_engine`.
    """

    def work(events: EventWriter, stop: StopSignal) -> None:
        from ..lift import bake_cameras, bake_frames  # late, as in `_run_lift`

        if cameras is not None:
            bake_cameras(folder, cameras, events, stop)
        if frames is not None:
            bake_frames(folder, frames, events, stop)

    left = "The result is whole, with what was baked so far"
    task = Task(work, False, BAKE, left, "bake again", "Bake again after closing other programs.")
    folder.refuse_foreign()
    if events_path is not None:
        _refuse_strange_events(folder, events_path)
        _refuse_unfinished(folder)
        return _bake_beside(folder, task, events_path, parent_pipe)
    try:
        lock = folder.lock().__enter__()
    except JobError:
        if parent_pipe is not None or folder.state_at_rest() is not LiftState.FINISHED:
            raise
        return _bake_beside(folder, task)
    try:
        _refuse_unfinished(folder)
        with output_to(folder.log_path) as terminal:
            folder.prepare_bake()
            return _run(folder, task, parent_pipe, terminal)
    finally:
        lock.__exit__(None, None, None)


def _bake_beside(
    folder: LiftFolder, task: Task, events_path: Path | None = None, parent_pipe: int | None = None
) -> ExitCode:
    """With a log and events of its own, which go when all went well: those of ``events_path`` only whoever follows
    them clears away. The lift's file 'cancel' stops this process too, one beside its events this process alone.
    """
    events = events_path or folder.path / f"bake-{platform.node()}-{os.getpid()}.jsonl"
    log_path = events.with_suffix(".log")
    with output_to(log_path) as terminal:
        code = _run(folder, task, parent_pipe, terminal, events)
    if events_path is None:
        events.unlink(missing_ok=True)
    if code is ExitCode.FINISHED:
        log_path.unlink(missing_ok=True)
    return code


def _refuse_strange_events(folder: LiftFolder, path: Path) -> None:
    """Raises JobError unless it is a file that bakers have: events are added to it, and a log beside it goes."""
    if path.suffix != ".jsonl" or path.resolve().parent != folder.path.resolve() / "bake":
        fix = f"Name a file of {folder.path / 'bake'} that ends in .jsonl, or leave --events out."
        raise JobError("a bake's events cannot go there", path, fix)


def _refuse_unfinished(folder: LiftFolder) -> None:
    """Raises JobError, also for a lift that was finished and is damaged."""
    if not folder.manifest_path.is_file():
        raise JobError(f"this lift is not finished ({folder.state_at_rest().value})", folder.path, "Resume it first.")
    verify_lifted(folder.result_path)


def _run(
    folder: LiftFolder, task: Task, parent_pipe: int | None, terminal: TextIO, events_path: Path | None = None
) -> ExitCode:
    events = EventWriter(events_path or folder.events_path)
    try:
        events.hello(threads=_threads(), resumed=task.resumed, task=task.name)
        _remember(folder)
        own_cancel = () if events_path is None else (events_path.with_suffix(".cancel"),)
        stop = StopSignal(folder.cancel_path, *own_cancel)
        with _signals_ask(stop), Watchdog(stop, events, parent_pipe=parent_pipe):
            code = _do(folder, events, stop, task, terminal)
        with suppress(OSError):  # a full disk; the manifest and the exit code tell it as well
            if code is ExitCode.FINISHED:
                events.done("finished")
            elif code in (ExitCode.CANCELLED, ExitCode.INTERRUPTED, ExitCode.TERMINATED):
                events.done("cancelled")
        _remember(folder)
        return code
    finally:
        events.close()


def _remember(folder: LiftFolder) -> None:
    """In the list of recent lifts: where that cannot be written, the lift matters more."""
    try:
        remember_lift(folder.path)
    except (OSError, JobError) as error:
        log.warning("this lift is not in the list of recent ones: %s", error)


def _do(folder: LiftFolder, events: EventWriter, stop: StopSignal, task: Task, terminal: TextIO) -> ExitCode:
    """Do the work; turn what it raises into an event, a line for people and an exit code."""
    try:
        stop.check()
        task.work(events, stop)
        if folder.state_at_rest() is not LiftState.FINISHED:
            raise RuntimeError("the lift ended without a manifest")
        return ExitCode.FINISHED
    except Cancelled as error:
        print(f"Stopped: {error}. {task.when_stopped}: {folder.path}", file=terminal)
        return stop.exit_code
    except (SceneError, JobError) as error:
        return _fail(events, terminal, error.what, error.where, error.fix, ExitCode.BAD_INPUT)
    except ModuleNotFoundError as error:
        traceback.print_exc()
        fix = f"Set the environment up anew with 'make set-up', then {task.again}."
        return _fail(events, terminal, str(error), sys.executable, fix, ExitCode.INTERNAL_ERROR)
    except MemoryError:
        traceback.print_exc()
        return _fail(events, terminal, "memory ran out", folder.path, task.with_less_memory, ExitCode.INTERNAL_ERROR)
    except Exception as error:  # the process's outermost frame: the traceback is kept, the user gets a line
        traceback.print_exc()
        if _is_of_a_full_disk(error):
            fix = f"Make room there, then {task.again}."
            return _fail(events, terminal, "the disk is full", folder.path, fix, ExitCode.INTERNAL_ERROR)
        what = f"the engine failed ({type(error).__name__}: {_first_line(error)})"
        fix = f"The log has the details. When the cause is gone, {task.again}."
        return _fail(events, terminal, what, folder.log_path, fix, ExitCode.INTERNAL_ERROR)


def _run_lift() -> Lift:
    """The real one, loaded late: it brings torch, and by now the watchdog can stop even a slow import."""
    from ..lift import run_lift

    return run_lift


def _fail(events: EventWriter, terminal: TextIO, what: str, where: object, fix: str, code: ExitCode) -> ExitCode:
    print(printable(f"error: {what}: {where}. {fix}"), file=terminal)
    try:
        events.error(what, str(where), fix, code)
    except OSError:  # the full disk that may be the very reason: the line above and the exit code tell it
        traceback.print_exc()
    return code


def _is_of_a_full_disk(error: Exception) -> bool:
    """Libraries in Rust have errors of their own, with the system's number in their text."""
    return getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or f"os error {errno.ENOSPC}" in str(error)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:300]


@contextmanager
def _signals_ask(stop: StopSignal) -> Iterator[None]:
    """Ctrl-C and SIGTERM stop the lift like the cancel file does, with their own exit codes."""
    if threading.current_thread() is not threading.main_thread():  # only there Python lets handlers be set
        yield
        return
    codes = {signal.SIGINT: ExitCode.INTERRUPTED, signal.SIGTERM: ExitCode.TERMINATED}

    def ask(signum: int, frame: FrameType | None) -> None:
        stop.ask(f"signal {signum}", codes[signal.Signals(signum)])

    before = {number: signal.signal(number, ask) for number in codes}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _threads() -> int:
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
