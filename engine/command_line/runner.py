"""Run a command: write its events, stop it when asked, and return how it ended."""

from __future__ import annotations

import errno
import faulthandler
import io
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from ..errors import STOPPED, Cancelled, ErrorCode, ExitCode, PlgsError, lacks_memory
from ..gates import open_to_append, printable
from ..job import Event, EventWriter, StopSignal, Watchdog
from ..job.lock import FileLock
from ..job.system import usable_cpus
from ..job.task import TaskFiles, TaskProgress
from ..job.terminal import STOP_SIGNALS, Interrupted, Interrupts, LiveLine, stop_signals_call
from ..json_file import to_line

Work = Callable[[EventWriter, StopSignal], object]

_FULL = "Make room there"
_NO_ROOM = {errno.ENOSPC: _FULL, errno.EDQUOT: _FULL, errno.EFBIG: "Raise the limit (ulimit -f)"}  # errno: the fix


@dataclass(frozen=True)
class Command:
    """A command to run: its ``kind``, its ``work``, and what its messages advise if it fails (``again``,
    ``with_less_memory``) or is stopped. It ends with the pipe ``parent_pipe``; events also go to the descriptor
    ``echo``. The files ``also_stops`` stop it as its own cancel file does."""

    kind: str
    work: Work
    resumed: bool = False
    when_stopped: str = ""
    again: str = "try again"
    with_less_memory: str = "Try again after closing other programs."
    parent_pipe: int | None = None
    echo: int | None = None
    also_stops: tuple[Path, ...] = ()


def run_in_terminal(command: Command, *, as_json: bool = False) -> ExitCode:
    """Run a command, with progress on standard error, and its answer on standard output, as text or ``as_json``.
    Returns how it ended."""
    events, stop = ShownEvents(sys.stderr, as_json=as_json), StopSignal()
    try:
        with Interrupts() as interrupts, Watchdog(stop, events, parent_pipe=command.parent_pipe):
            code = _do(command, events, stop, sys.stderr, None)
            if interrupts.pending is not None:  # native code may have turned it into another error
                raise Interrupted(interrupts.pending)
            return code
    except Interrupted as error:
        events.close()
        print(f"Stopped. {command.when_stopped}".strip(), file=sys.stderr)
        return error.exit_code
    finally:
        events.close()


def run_at(command: Command, files: TaskFiles, terminal: TextIO) -> ExitCode:
    """Run a command with events in ``files``, which are locked; output goes to their log, some to ``terminal``."""
    at = files.events, command.echo
    events = EventWriter(*at) if command.parent_pipe is not None else FiledAndShownEvents(*at, terminal)
    try:
        given = os.environ.get("OMP_NUM_THREADS", "")
        threads = int(given) if given.isdecimal() and int(given) > 0 else usable_cpus()
        events.hello(task=command.kind, threads=threads, resumed=command.resumed)
        stop = StopSignal(files.cancel, *command.also_stops)
        with _signals_ask(stop), Watchdog(stop, events, parent_pipe=command.parent_pipe):
            code = _do(command, events, stop, terminal, files)
        with suppress(OSError):  # the disk may be full; the result and the exit code tell it too
            if code is ExitCode.FINISHED:
                events.done("finished")
            elif code in STOPPED:
                events.done("cancelled")
        return code
    finally:
        events.close()


def run_task(command: Command, files: TaskFiles | None, *, as_json: bool = False) -> ExitCode:
    """Run a command in the terminal (its answer ``as_json``) or, given ``files``, with its events there. Raises
    PlgsError if the files are in use."""
    if files is not None:
        with FileLock(files.events), output_to(files.log) as terminal:
            return run_at(command, files, terminal)
    if command.echo is None:
        return run_in_terminal(command, as_json=as_json)
    own = TaskFiles.temporary()
    try:
        return run_at(command, own, sys.stderr)
    finally:
        own.discard()


def _do(command: Command, events: EventWriter, stop: StopSignal, terminal: TextIO, files: TaskFiles | None) -> ExitCode:
    """Do the command's work. An error becomes an event, a line for the user on ``terminal``, and an exit code."""
    try:
        stop.check()
        command.work(events, stop)
        return ExitCode.FINISHED
    except Cancelled as error:
        if isinstance(events, FiledAndShownEvents):
            events.end_line()
        print(f"Stopped: {error}. {command.when_stopped}".strip(), file=terminal)
        return stop.exit_code
    except BrokenPipeError:  # `main` ends quietly, as no one reads the output
        raise
    except PlgsError as error:
        failure = error
        if (number := _number_without_room(error.what)) is not None:  # no room, whichever file could not be written
            fix = f"{_NO_ROOM[number]}, then {command.again}." + (f" Or: {error.fix}" if error.option else "")
            failure = PlgsError(error.key, error.what, error.where, fix, code=ErrorCode.DISK_FULL, option=error.option)
        if files is not None and "\n" in str(error.__cause__ or "").strip():
            traceback.print_exc()  # into the log, as the line is only a short form
    except Exception as error:  # the process's outermost frame: the log gets the traceback, the user a line
        failure = failure_of(error, command, files)
        if files is not None or failure.code is ErrorCode.INTERNAL:
            traceback.print_exc()
    try:
        events.error(failure)
    except OSError:  # the disk may be full, as the line below and the exit code then tell
        traceback.print_exc()
    print(f"error: {failure}", file=terminal)
    return failure.exit_code


def drop_output() -> None:
    """Redirect a broken standard output to the null device, as Python flushes the rest of it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def failure_of(error: Exception, command: Command, files: TaskFiles | None = None) -> PlgsError:
    """Return a PlgsError about another kind of ``error``: memory, a disk, a missing module, or a bug."""
    where = Path(sys.executable) if files is None else files.log
    if isinstance(error, ModuleNotFoundError):
        fix = f"Set the environment up again with 'make set-up', then {command.again}."
        return PlgsError("engine-unusable", str(error), sys.executable, fix, code=ErrorCode.INTERNAL)
    if lacks_memory(error):
        return PlgsError("no-memory", "memory ran out", where.parent, command.with_less_memory, code=ErrorCode.INTERNAL)
    named = re.search(r'"(/[^"]+)"', str(error))  # of C++ libraries
    at = str(getattr(error, "filename", None) or (named and named[1]) or ("" if files is None else where.parent))
    number = _number_of(error)
    if number in _NO_ROOM:
        too_large = "a file is larger than the disk or the limit on files allows"
        what = too_large if number == errno.EFBIG else "the disk is full"
        fix = f"{_NO_ROOM[number]}, then {command.again}."
        return PlgsError("disk-full", what, at, fix, code=ErrorCode.DISK_FULL)
    if number is not None:
        why = getattr(error, "strerror", None) or os.strerror(number)
        return PlgsError("unusable", f"this cannot be used ({why})", at, f"Fix this, then {command.again}.")
    what = f"the engine failed ({type(error).__name__}: {(str(error).splitlines() or [''])[0][:300]})"
    fix = f"The log has the details. Once the cause is fixed, {command.again}."
    if isinstance(error, ImportError) and os.environ.get("PYTHONPATH"):
        fix = f"Unset PYTHONPATH, which leads to other programs' modules, then {command.again}."
    return PlgsError("internal", what, where, fix, code=ErrorCode.INTERNAL)


def _number_of(error: Exception) -> int | None:
    """Return the system's number of an error, if any. Rust's errors name it; C++ libraries' give only its message."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    found = re.search(r"\(os error (\d+)\)", str(error))
    if found is not None:
        return int(found[1])
    return _number_without_room(str(error))


def _number_without_room(text: str) -> int | None:
    return next((number for number in _NO_ROOM if os.strerror(number) in text), None)


@contextmanager
def _signals_ask(stop: StopSignal) -> Iterator[None]:
    """Let signals stop the task like its cancel file does, but with exit codes of their own."""

    def ask(signum: int, frame: FrameType | None) -> None:
        stop.ask(f"signal {signum}", STOP_SIGNALS[signal.Signals(signum)])

    before = stop_signals_call(ask)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class ShownEvents(EventWriter):
    """Shows the events of a command that no other process follows: progress goes to ``stream``, and the answer to
    standard output, as one line of JSON or as text."""

    def __init__(self, stream: TextIO, *, as_json: bool) -> None:
        self._folder, self._as_json = Path(), as_json
        self._line, self._progress = LiveLine(stream), TaskProgress()

    def answer(self, answer: Mapping[str, object], text: str = "") -> None:
        self._line.end()
        sys.stdout.flush()
        said = (  # a path that is not UTF-8 has lone surrogates, which cannot be encoded
            (printable(text) + "\n").encode(errors="backslashreplace")
            if text and not self._as_json
            else to_line(answer)
        )
        try:
            sys.stdout.buffer.write(said)  # UTF-8 on every system, as a path may need
            sys.stdout.flush()
        except OSError:
            drop_output()
            raise

    def close(self) -> None:
        self._line.end()

    def _write(self, event: str, /, **data: Any) -> None:
        if event == "warning":
            self._line.say(f"warning: {data['message']}")
        elif event in ("stage", "progress"):
            self._progress.take(Event(0, 0.0, event, data), self._folder)
            if event == "progress" or self._progress.stage_index > 1:  # bad input ends in the first, with one line
                self._line.show(self._progress)
        else:
            self._line.end()


class FiledAndShownEvents(EventWriter):
    """Writes events to a file, for a command that no other process follows, and shows warnings on ``stream`` and, if
    that is a terminal, progress. (A farm's or a nohup's log would grow by a line every few seconds.)"""

    def __init__(self, path: Path, echo: int | None, stream: TextIO) -> None:
        super().__init__(path, echo)
        self._shown = ShownEvents(stream, as_json=False)
        self._is_shown = {"warning", "error", "done", *(("stage", "progress") if stream.isatty() else ())}

    def _write(self, event: str, /, **data: Any) -> None:
        super()._write(event, **data)
        if event in self._is_shown:
            self._shown._write(event, **data)

    def end_line(self) -> None:
        """End the live line, so that further output begins on a new one."""
        self._shown.close()


@contextmanager
def output_to(log: Path) -> Iterator[TextIO]:
    """Append all output to ``log`` in a ``with`` block. Yields the real standard error, for the few lines that the user
    shall see. The file descriptors below Python's streams are redirected too, for the output of C++ and its crashes."""
    sys.stdout.flush()
    sys.stderr.flush()
    out, err = os.dup(1), os.dup(2)
    raw = io.BufferedWriter(_BestEffortFile(open_to_append(log), "ab"))
    with (
        io.TextIOWrapper(raw, encoding="utf-8", errors="replace", line_buffering=True) as file,
        os.fdopen(os.dup(2), "w", encoding="utf-8", errors="replace", buffering=1) as terminal,
    ):
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            with redirect_stdout(file), redirect_stderr(file), _logging_to(file):
                yield terminal
        finally:
            for saved, number in ((out, 1), (err, 2)):
                os.dup2(saved, number)
                os.close(saved)


class _BestEffortFile(io.FileIO):
    """A file for output that may be lost on a full disk: a log must neither make a lift fail nor hide its error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError:
            return memoryview(data).nbytes  # as if it was written, or the buffer would try again and again


@contextmanager
def _logging_to(file: TextIO) -> Iterator[None]:
    handler = logging.StreamHandler(file)
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    root = logging.getLogger()
    level, were_faults_told = root.level, faulthandler.is_enabled()
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    faulthandler.enable(file=file)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(level)
        if were_faults_told:
            faulthandler.enable(file=sys.__stderr__ or 2)  # None if the process began without the stream
        else:
            faulthandler.disable()
