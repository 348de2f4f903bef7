"""A task is one run of an engine's command, followed by another process: its files, its progress, and how it is
stopped."""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from ..errors import Cancelled, ExitCode, PlgsError
from ..gates import inner_path, open_plain
from ..json_file import Json
from .events import Event, EventWriter

LIFT, BAKE = "lift", "bake"
"""The kinds of tasks that work in a lift folder. Other kinds have the names of the engine's commands."""
LIVE_PREVIEW = "result/previews/live.png"
"""A picture of the model during training, replaced by rename every few seconds; gone when the lift is finished."""
LOG_LINES = 40
"""The number of lines at a log's end that hold a Python traceback, or what a crash in native code leaves."""
LOG_BYTES = 1 << 16
"""At most this many bytes at a log's end are read for them."""
_LONGEST_LINE = 500
_MOST_WARNINGS = 1_000  # maximum number of warnings kept of a task
_MOST = 1 << 62  # the largest count and number of seconds that is accepted
_NO_LINK: int = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)  # O_NONBLOCK: a FIFO would wait


class TaskState(StrEnum):
    RUNNING = "running"
    FINISHED = "finished"
    CANCELLED = "cancelled"
    FAILED = "failed"


@dataclass(frozen=True)
class TaskFiles:
    """The three files that a task shares with its follower: its ``events``, the ``cancel`` file that stops it, and its
    ``log``. ``arguments`` are the command-line arguments that name them (none for a lift, whose folder implies them).
    ``folder`` is a temporary folder that is deleted with the task, or None."""

    events: Path
    cancel: Path
    log: Path
    arguments: tuple[str | Path, ...] = ()
    folder: Path | None = None

    @classmethod
    def of_lift(cls, lift: Path) -> TaskFiles:
        return cls(lift / "events.jsonl", lift / "cancel", lift / "log.txt")

    @classmethod
    def at(cls, events: Path) -> TaskFiles:
        """The files beside ``events``, whose name ends in .jsonl. Raises PlgsError if they cannot be written."""
        events = events.absolute()
        if events.suffix != ".jsonl" or not events.parent.is_dir():
            fix = "Give --events a name that ends in .jsonl, in an existing folder."
            raise PlgsError("unwritable", "the events cannot be written there", events, fix, option="--events")
        return cls(events, events.with_suffix(".cancel"), events.with_suffix(".log"), ("--events", events))

    @classmethod
    def temporary(cls, parent: Path | None = None) -> TaskFiles:
        """Files in a new folder that only this user may read, in the system's temporary folder unless ``parent`` is
        given. `discard` removes it. Raises OSError."""
        files = cls.at(Path(tempfile.mkdtemp(prefix="plgs-task-", dir=parent)) / "events.jsonl")
        return replace(files, folder=files.events.parent)

    def ask_to_cancel(self) -> None:
        """Make the cancel file: the engine stops at its next step. A link is not followed. Raises OSError."""
        os.close(os.open(self.cancel, os.O_WRONLY | os.O_CREAT | _NO_LINK, 0o666))

    def discard(self) -> None:
        """Delete the files of a task that has ended. Raises OSError."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
            return
        for path in (self.events, self.cancel, self.log):
            path.unlink(missing_ok=True)


@dataclass
class TaskProgress:
    """The state of a run, in the stage ``stage``, for people ``label``. Stages count from 1 (``stage_index``); ``step``
    of ``steps`` of this one are done, ``eta_s`` seconds of it remain, and ``left_s`` of the whole run, if known.
    ``began`` is the start in Unix seconds. ``live_preview`` is a picture of the growing model; it was replaced
    ``live_previews`` times, lastly as seen by the camera with the fingerprint ``live_preview_camera``. ``previews`` are
    the pictures that stay."""

    stage: str = ""
    label: str = "Starting"
    stage_index: int = 0
    stage_count: int = 0
    step: int = 0
    steps: int = 0
    loss: float | None = None
    eta_s: float | None = None
    left_s: float | None = None
    previews: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    live_preview: Path | None = None
    live_previews: int = 0
    live_preview_camera: str = ""
    began: float | None = None

    def take(self, event: Event, folder: Path) -> None:
        """Update the progress with an event. Paths in events are relative to ``folder``, where the events' file is."""
        data = event.data
        match event.kind:
            case "stage":
                self.stage, self.label = str(data["name"]), str(data["label"])
                self.stage_index, self.stage_count = _int(data["index"]), _int(data["count"])
                self.step, self.steps, self.loss, self.eta_s = 0, 0, None, None
            case "progress":
                self.step, self.steps = _int(data["step"]), _int(data["steps"])
                self.loss, self.eta_s = _float(data.get("loss")), _float(data.get("eta_s"))
                self.left_s = _float(data.get("left_s"))
            case "preview" if data["path"] == LIVE_PREVIEW:
                self.live_preview = folder / LIVE_PREVIEW
                self.live_previews += 1
                self.live_preview_camera = str(data.get("camera", ""))
            case "preview" if path := _inside(data["path"], folder):
                self.previews.append(path)
            case "warning" if len(self.warnings) < _MOST_WARNINGS:
                self.warnings.append(str(data["message"]))


def last_lines(log: Path, count: int = LOG_LINES) -> tuple[str, ...]:
    """Return the last ``count`` lines of a log that are not blank, cut at 500 characters; none without a log. Only its
    last 64 KB are read. Each version of a line that was overwritten, such as a progress bar, counts as a line."""
    try:
        with open_plain(log, follow_link=False) as file:
            start = max(0, os.fstat(file.fileno()).st_size - LOG_BYTES)
            file.seek(start)
            content = file.read(LOG_BYTES)
    except OSError:  # never begun, or deleted
        return ()
    lines = content.decode("utf-8", errors="replace").splitlines()
    shown = [line.rstrip()[:_LONGEST_LINE] for line in lines[1 if start else 0 :] if line.strip()]  # the 1st may be cut
    return tuple(shown[-count:])


def _inside(path: Json, folder: Path) -> Path | None:
    """Return the path, or None if it leads out of the folder: someone else may have written the event."""
    try:
        return folder / inner_path(str(path))
    except ValueError:
        return None


def _int(value: Json) -> int:
    """Return the number, or 0 for anything that is not a valid count."""
    return value if isinstance(value, int) and 0 <= value <= _MOST else 0


def _float(value: Json) -> float | None:
    """Return the number; None for NaN, infinity, numbers too large for a float, and anything else."""
    if not isinstance(value, int | float) or not -_MOST <= value <= _MOST:
        return None
    return float(value)


POLL_S = 0.1
"""Seconds between two checks of the cancel file."""
GRACE_S = 0.5
"""Seconds from the request to the forced end. With the poll and the process's exit, it all takes less than a second."""


class StopSignal:
    """Tells the engine's loops when to stop: they call ``stop.check()`` in every step."""

    def __init__(self, *cancel_paths: Path) -> None:
        """Take the files whose existence stops the task."""
        self._cancel_paths = cancel_paths
        self._reason: str | None = None
        self.exit_code = ExitCode.CANCELLED

    def check(self) -> None:
        """Raise Cancelled if the task should stop. It takes a few microseconds."""
        reason = self.reason
        if reason is not None:
            raise Cancelled(reason)

    @property
    def reason(self) -> str | None:
        """Why the task should stop; None if it should continue."""
        if self._reason is None:
            for path in self._cancel_paths:
                with suppress(OSError):  # the disk may not answer now (EIO, ESTALE); the next check will show
                    if path.exists():
                        self._reason = f"the file '{path.name}' exists"
        return self._reason

    def ask(self, reason: str, exit_code: ExitCode = ExitCode.CANCELLED) -> None:
        """Ask the task to stop: the next check raises Cancelled for this reason; the exit status is ``exit_code``."""
        self.exit_code = exit_code
        self._reason = reason


class Watchdog:
    """Ends the engine if its main thread does not stop in time; for ``with``, around the whole work. Threads are
    allowed here: this is the engine's own process, not Blender's Python, and the two threads never touch the task's
    data. One polls the cancel file. The other waits for the end of the pipe ``parent_pipe``, a descriptor whose write
    end only the parent holds: on every system the pipe ends when the parent does. To end it by force is safe because
    all files are put in place by rename. It is impossible while native code in the main thread holds Python's lock;
    then the parent kills the process (`follower`)."""

    def __init__(
        self,
        stop: StopSignal,
        events: EventWriter,
        *,
        parent_pipe: int | None = None,
        grace_s: float = GRACE_S,
        end_process: Callable[[int], object] = os._exit,  # sys.exit would end only the watchdog's thread
    ) -> None:
        self._stop, self._events, self._parent_pipe = stop, events, parent_pipe
        self._grace_s, self._end_process = grace_s, end_process
        self._over = threading.Event()
        self._asked = threading.Event()  # wakes the watcher before its next poll

    def __enter__(self) -> Watchdog:
        threading.Thread(target=self._watch, name="plgs-watchdog", daemon=True).start()
        if self._parent_pipe is not None:
            threading.Thread(target=self._await_parent, name="plgs-parent", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._asked.set()

    def _await_parent(self) -> None:
        assert self._parent_pipe is not None
        await_end(self._parent_pipe)
        self._stop.ask("the process that started the engine has ended")
        self._asked.set()

    def _watch(self) -> None:
        while self._stop.reason is None:
            if self._over.is_set():
                return
            self._asked.wait(POLL_S)
        if not self._over.wait(self._grace_s):
            with suppress(OSError):  # a full disk must not keep the engine alive
                self._events.done("cancelled")
            self._end_process(self._stop.exit_code)


def await_end(pipe: int) -> None:
    while os.read(pipe, 4096):
        pass
