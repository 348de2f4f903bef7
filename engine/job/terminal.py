"""Run tasks and whole lifts in a terminal: one live line, and Ctrl-C that ends both processes within a second."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from ..errors import OF_SIGNALS, ErrorCode, ExitCode, PlgsError
from ..gates import open_to_append, printable
from ..json_file import Json
from ..scene_source import FILMS, MADE_POSES
from .events import at_work, echoed
from .folder import LiftFolder, LiftState
from .follower import TaskFollower
from .process import engine_call, engine_command, engine_python
from .request import request_from
from .studio import filled_in
from .task import LIFT, TaskFiles, TaskProgress, TaskState

_POLL_S = 0.05
_PLAIN_LINE_S = 5.0
STOP_SIGNALS = {getattr(signal, name): code for name, code in OF_SIGNALS.items() if hasattr(signal, name)}
"""`OF_SIGNALS` by the numbers of this system."""


class Interrupted(KeyboardInterrupt):  # no `except Exception` on the way catches it, and asyncio does not either
    """A signal asked this process to end; ``exit_code`` is the exit status for it."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.exit_code = STOP_SIGNALS[signal.Signals(signum)]


def stop_signals_call(handler: Callable[[int, FrameType | None], object]) -> dict[signal.Signals, Any]:
    """Let ``handler`` take the signals that stop a command, and return their earlier handlers. A signal that was
    ignored, as with nohup, stays so. Outside the main thread, where Python allows no handlers, nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    taken = [number for number in STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in taken}


class Interrupts:
    """Handles `STOP_SIGNALS` in a ``with`` block, instead of Blender's own handlers. A signal raises Interrupted at
    once or, inside `deferred`, at its end, for code that must not be interrupted. During an import, native code may
    turn Interrupted into another error; if the block ends with one, Interrupted is raised again."""

    def __init__(self) -> None:
        self.pending: int | None = None
        self._deferred = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        self._before = stop_signals_call(self._on_signal)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        for number, handler in self._before.items():
            # None: something other than Python (Blender) installed it, and it cannot be restored from here.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if self.pending is not None and isinstance(error, Exception):
            raise Interrupted(self.pending) from error

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self.pending = signum
        if not self._deferred:
            raise Interrupted(signum)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Hold signals back in a ``with`` block. After the block, a signal that came raises Interrupted."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False
        if self.pending is not None:
            raise Interrupted(self.pending)


def follow(follower: TaskFollower, interrupts: Interrupts, line: LiveLine, echo: int | None = None) -> None:
    """Show the task until it ends. Call it, and start the engine, inside `interrupts.deferred()`. The task's events go
    to the descriptor ``echo``, if any. A signal cancels the task, and an engine that does not stop is killed."""
    is_asked, is_told, warned = False, False, 0
    if echo is not None:
        follower.on_event = lambda event: echoed(event.line, echo)
    try:
        while follower.is_running:
            follower.poll()
            for warning in follower.progress.warnings[warned:]:
                line.say(f"warning: {warning}")
            warned = len(follower.progress.warnings)
            line.show(follower.progress)
            if line.is_lost and not is_told:
                is_told = True
                with suppress(OSError), os.fdopen(open_to_append(follower.files.log), "a", encoding="utf-8") as log:
                    log.write("The terminal was closed. The work continues.\n")  # if there is room
            if interrupts.pending is not None and not is_asked:
                is_asked = True
                line.say("Stopping ...")
                follower.cancel()
            if follower.is_running:
                time.sleep(_POLL_S)
    finally:
        line.end()
        if follower.is_running:  # after an error such as a full disk: never leave an engine behind
            follower.kill()
        follower.close()


def stdout_for_events(progress: str) -> int | None:
    """With --progress json, reserve standard output for events and return a new descriptor of it; what is printed goes
    to standard error instead. Otherwise return None."""
    if progress != "json":
        return None
    sys.stdout.flush()
    events = os.dup(1)
    os.dup2(2, 1)
    return events


class LiveLine:
    """Shows progress on one line that is overwritten repeatedly or, if that is impossible, on a new line every few
    seconds. ``is_lost`` says that nobody reads the stream any more (a closed terminal, or ``| head``): output is then
    discarded, so that hours of work don't end with an error."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.is_lost = False
        self._live = stream.isatty()
        self._newest = ""
        self._shown = ""
        self._stage = ""
        self._next = 0.0

    def show(self, progress: TaskProgress) -> None:
        """Show the current state; this takes almost no time if nothing changed."""
        text = printable(describe(progress))
        if self._live:
            if text != self._shown:
                self._overwrite(text)
            return
        is_new_stage = progress.stage != self._stage
        if is_new_stage:
            self._print_newest()  # how far the last stage got
        self._newest, self._stage = text, progress.stage
        if is_new_stage or time.monotonic() >= self._next:
            self._print_newest()

    def say(self, text: str) -> None:
        """Print a line of text above the live one."""
        if self._live and self._shown:
            self._overwrite("")
        self._write(printable(text) + "\n")

    def end(self) -> None:
        """End the live line: its last state stays visible, and further output begins on a new line."""
        if not self._live:
            self._print_newest()
        elif self._shown:
            self._write("\n")
            self._shown = ""

    def _print_newest(self) -> None:
        if self._newest and self._newest != self._shown:
            self._write(self._newest + "\n")
            self._shown, self._next = self._newest, time.monotonic() + _PLAIN_LINE_S

    def _overwrite(self, text: str) -> None:
        text = text[: shutil.get_terminal_size().columns - 1]  # a full line would wrap, and "\r" not undo that
        self._write("\r" + text + " " * max(0, len(self._shown) - len(text)) + ("" if text else "\r"))
        self._shown = text

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            self.is_lost = True
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())  # Python flushes the stream again when it exits
            os.close(nowhere)


def describe(progress: TaskProgress) -> str:
    """Return a text such as "[3/6] Training  1200/3000  loss 0.0123  2:31 left  3:20 to the end"."""
    stage = f"[{progress.stage_index}/{progress.stage_count}] " if progress.stage_count > 1 else ""
    parts = [stage + progress.label]
    if progress.steps:
        parts.append(f"{progress.step}/{progress.steps}")
    if progress.loss is not None:
        parts.append(f"loss {progress.loss:.4f}")
    if progress.eta_s is not None and progress.step < progress.steps:
        parts.append(f"{_clock(progress.eta_s)} left")
    if progress.left_s is not None and progress.stage_index < progress.stage_count:
        parts.append(f"{_clock(progress.left_s)} to the end")
    return "  ".join(parts)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(max(0.0, seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return (f"{hours}:{minutes:02d}" if hours else f"{minutes}") + f":{rest:02d}"


_ENDING_S = 2.0  # seconds that an engine whose parent was killed may need to end


def lift_in_terminal(
    options: argparse.Namespace,
    interrupts: Interrupts,
    on_error: Callable[[PlgsError], object] = lambda error: print(f"error: {error}", file=sys.stderr),
) -> tuple[LiftFolder, ExitCode]:
    """Lift a scene as ``options`` ask: those of `add_lift_options`, ``scene``, ``output`` and ``resume``. Progress goes
    to stderr, and events to the descriptor ``echo`` if the options have one. ``on_error`` is called with the error of a
    failed engine. The engine itself checks the scene and whether a finished lift has anything left to do. A folder made
    for a lift that never began is removed, so that the corrected command works. If the options have a ``program``, that
    does the lift (see `engine_call`). Raises PlgsError, and Interrupted on Ctrl-C after the engine has ended."""
    python = engine_python()
    if options.poses is not None:  # an engine finds them, unless an earlier one has
        options.scene = Path(str(ask_engine(python, interrupts, "poses", options.scene)["folder"]))
    elif _is_film_or_prepared(options.scene):
        _prepare(options, python, interrupts)
    lift = resumable(options)
    is_new, finished_at = lift is None, None
    if lift is None:
        try:
            lift = LiftFolder.create(options.output, request_from(filled_in(options)))
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
        with interrupts.deferred():
            follower = TaskFollower.start(command, lift.task_files, kind=LIFT, lift=lift)
            follow(follower, interrupts, LiveLine(sys.stderr), getattr(options, "echo", None))
        if follower.error is not None and not _lacks_poses(follower.error, options):
            on_error(follower.error)
        elif follower.state is TaskState.CANCELLED:
            print(f"Cancelled. Give the same command with --resume to continue: {lift.path}", file=sys.stderr)
    finally:
        if is_new and lift.came_to_nothing():
            lift.discard()
    code = follower.exit_code
    if follower.error is not None and _lacks_poses(follower.error, options):
        _prepare(options, python, interrupts)
        return lift_in_terminal(options, interrupts, on_error)
    if code is ExitCode.FINISHED and finished_at == lift.manifest_path.stat().st_mtime_ns:
        print(f"This lift is finished already: {lift.path}", file=sys.stderr)
    return lift, code


def _is_film_or_prepared(scene: Path) -> bool:
    """Whether a scene is a film, or photos whose poses `prepare` or `poses` found earlier."""
    return (scene.suffix.lower() in FILMS and scene.is_file()) or (scene / MADE_POSES).is_file()


def _lacks_poses(error: PlgsError, options: argparse.Namespace) -> bool:
    """Whether a lift failed because its scene consists of photos without poses, which `_prepare` could still find."""
    return error.code is ErrorCode.NO_POSES and options.poses is None and not _is_film_or_prepared(options.scene)


def _prepare(options: argparse.Namespace, python: Path, interrupts: Interrupts) -> None:
    """Let an engine make what photos or a film lack for a lift; set ``options.scene`` to the folder that has all."""
    have = [name for name in ("depth", "masks") if getattr(options, name) is not None]
    more = [*(["--have", *have] if have else []), *(["--download"] if getattr(options, "download", False) else [])]
    options.scene = Path(str(ask_engine(python, interrupts, "prepare", options.scene, *more)["folder"]))


def resumable(options: argparse.Namespace) -> LiftFolder | None:
    """Return the lift in ``options.output`` that --resume continues; None if there is nothing to continue. Raises
    PlgsError if the options ask for another lift than the one there."""
    if not options.resume or not (options.output / "request.json").exists():
        return None
    lift = LiftFolder.open(options.output)
    return lift.asked_again(request_from(options, base=lift.request))


def ask_engine(python: Path, interrupts: Interrupts, kind: str, *arguments: str | Path) -> Mapping[str, Json]:
    """Run the engine's command ``kind``, progress on stderr; return its answer. Raises its PlgsError, Interrupted."""
    given = (each.absolute() if isinstance(each, Path) else each for each in arguments)  # it runs in another folder
    with interrupts.deferred():
        follower = TaskFollower.start([*engine_call(python), kind, *given], TaskFiles.temporary(), kind=kind)
        follow(follower, interrupts, LiveLine(sys.stderr))
    if follower.error is not None or follower.answer is None:
        raise follower.error or PlgsError("silent", "the engine gave no answer", kind, "Run the same command again.")
    return follower.answer


def _state_when_left_alone(lift: LiftFolder) -> LiftState:
    """Return a lift's state once no engine works on it. Raises PlgsError if one still does after two seconds. Without
    this check, Ctrl-C here would write a cancel file that stops the other engine."""
    give_up = time.monotonic() + _ENDING_S
    while (state := lift.state()) is LiftState.RUNNING:
        if time.monotonic() > give_up:
            raise at_work(lift.events_path)
        time.sleep(0.05)
    return state
