"""The typed events that every command of the engine writes: one JSON object per line, appended in one write."""

from __future__ import annotations

import json
import os
import platform
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from .. import __version__
from ..errors import ErrorCode, PlgsError
from ..gates import open_plain, open_to_append
from ..json_file import Json, to_line

_KEYS: Mapping[str, frozenset[str]] = {
    "hello": frozenset(),
    "stage": frozenset({"name", "index", "count", "label"}),
    "progress": frozenset({"step", "steps"}),
    "metric": frozenset({"name", "values"}),
    "preview": frozenset({"path"}),
    "artifact": frozenset({"path", "kind"}),
    "warning": frozenset({"message"}),
    "answer": frozenset({"answer"}),
    "error": frozenset({"what", "where", "fix"}),
    "done": frozenset({"state"}),
}
"""The kinds of events, with the keys that a reader may rely on."""
TAIL_BYTES = 16384
"""Bytes at the end of a file that are read for the last events of a run: an error, and the end."""
LONGEST_TAIL = 1 << 20
"""Bytes at the end of a file that are searched if those hold no event."""
LONGEST_ANSWER = 1 << 22
"""Bytes: the longest line that a hurried reader accepts as an event."""
MOST_AT_ONCE = 1 << 26
"""Bytes: the most that is read at once."""
MOST_BYTES = 1 << 17
"""Bytes that a hurried reader reads at once, in about a millisecond."""
MOST_CAUGHT_UP = 1 << 24
"""Bytes: older events farther from the end than this are skipped by a hurried reader."""
_PROGRESS = b'"event": "progress"'


@dataclass(frozen=True)
class Event:
    """One event. ``seq`` rises by one, ``time`` is in Unix seconds, ``data`` has the other keys of its ``kind``."""

    seq: int
    time: float
    kind: str
    data: Mapping[str, Json]

    @property
    def line(self) -> bytes:
        return to_line({"seq": self.seq, "time": self.time, "event": self.kind, **self.data})


class EventWriter:
    """Appends events. Only the process that holds the lock on the file may do so. It is thread-safe. ``seq`` continues
    where an earlier run ended; a line that a kill left incomplete is removed first. ``echo`` is a descriptor to which
    each line is also written, as long as someone reads it. Raises OSError if the disk is full."""

    def __init__(self, path: Path, echo: int | None = None) -> None:
        self.path, self._echo = path, echo
        self._lock = threading.Lock()
        self._done = False
        self._began = time.monotonic()
        self._torn = False
        self._descriptor = open_to_append(path)
        self._seq = self._repair(path)

    def _repair(self, path: Path) -> int:
        """Remove an incomplete last line, and return the highest ``seq`` near the end. A tail without lines stays."""
        start, content = _tail(path, LONGEST_TAIL)
        whole = content.rfind(b"\n") + 1
        self._torn = start > 0 and not whole
        if whole < len(content) and not self._torn:
            os.ftruncate(self._descriptor, whole)
        return max((event.seq for event in _parsed(content[:whole].splitlines())), default=0)

    def hello(self, *, threads: int, resumed: bool, task: str = "lift") -> None:
        """Report that a run of ``task`` ("lift", "bake" …) begins or is ``resumed``, with this many compute threads."""
        about = {"engine_version": __version__, "pid": os.getpid(), "machine": platform.node()}
        about["python"] = platform.python_version()
        self._write("hello", task=task, **about, threads=threads, resumed=resumed)

    def stage(self, name: str, index: int, count: int, label: str) -> None:
        """Report that stage ``name`` begins, number ``index`` (from 1) of ``count``; ``label`` is for the user."""
        self._write("stage", name=name, index=index, count=count, label=label)

    def progress(
        self,
        stage: str,
        step: int,
        steps: int,
        *,
        loss: float | None = None,
        eta_s: float | None = None,
        left_s: float | None = None,
    ) -> None:
        """Report that ``step`` of ``steps`` are done. The stage takes ``eta_s`` seconds more, the run ``left_s``."""
        self._write("progress", stage=stage, step=step, steps=steps, loss=loss, eta_s=eta_s, left_s=left_s)

    def metric(self, name: str, values: Mapping[str, float | int | str | None]) -> None:
        """Report figures that belong together, such as one row of the final table."""
        self._write("metric", name=name, values=values)

    def preview(self, path: Path, camera: str = "") -> None:
        """Report that a picture was written to look at. ``camera`` is the fingerprint of the requested camera."""
        self._write("preview", path=self._relative(path), **({"camera": camera} if camera else {}))

    def artifact(self, path: Path, kind: str) -> None:
        """Report that a file of the result was written, of a ``kind`` such as "pass"."""
        self._write("artifact", path=self._relative(path), kind=kind)

    def warning(self, message: str) -> None:
        """Report something that the user should know; the run continues."""
        self._write("warning", message=" ".join(message.splitlines()))

    def answer(self, answer: Mapping[str, object], text: str = "") -> None:
        """Report the command's answer, at most once per run. ``text`` says the same for users of a terminal."""
        self._write("answer", answer=answer)

    def error(self, error: PlgsError) -> None:
        """Report the error that ends the run."""
        about = {"key": error.key, "what": error.what, "where": error.where, "fix": error.fix}
        self._write("error", **about, code=error.code, option=error.option, exit_code=error.exit_code)

    def done(self, state: str) -> None:
        """Report that the run is over: "finished" or "cancelled". Later events are dropped."""
        self._write("done", state=state, seconds=round(time.monotonic() - self._began, 3))

    def close(self) -> None:
        with self._lock:
            if self._descriptor >= 0:
                os.close(self._descriptor)
            self._descriptor, self._done = -1, True

    def _write(self, event: str, /, **data: object) -> None:
        with self._lock:
            if self._done:
                return
            head = {"seq": self._seq + 1, "time": round(time.time(), 3), "event": event}
            line = to_line(head | data)
            self._append(b"\n" + line if self._torn else line)
            if self._echo is not None and not echoed(line, self._echo):
                self._echo = None
            self._seq += 1
            self._done = event == "done"

    def _append(self, line: bytes) -> None:
        """Append a line. Raises OSError, for example on a full disk; what was written of the line is then removed."""
        start, written = os.fstat(self._descriptor).st_size, 0
        try:
            while written < len(line):
                written += os.write(self._descriptor, line[written:])
        except OSError:
            if written:
                self._torn = True
                os.ftruncate(self._descriptor, start)
                self._torn = line.startswith(b"\n")  # the line is gone: only an older torn end is left
            raise
        self._torn = False

    def _relative(self, path: Path) -> str:
        """Return the path relative to the events' folder if it is inside, so that the folder can be moved."""
        inside = path.is_relative_to(self.path.parent)
        return (path.relative_to(self.path.parent) if inside else path).as_posix()


class EventReader:
    """Follows an events file that another process appends to. Its position is always the end of a complete line: a line
    that is still being written is read again later. ``from_end`` skips the lines that exist already. ``hurried`` is for
    a window's loop: a call reads at most MOST_BYTES (``is_behind`` says whether there is more) and keeps only the last
    of consecutive progress events. Raises OSError."""

    def __init__(self, path: Path, *, from_end: bool = False, hurried: bool = False) -> None:
        self._path, self._offset, self._hurried = path, 0, hurried
        self.is_behind = False
        if hurried:
            with suppress(FileNotFoundError):  # an incomplete line there is not an event
                self._offset = max(0, path.stat().st_size - MOST_CAUGHT_UP)
        if from_end and path.exists():
            start, tail = _tail(path, LONGEST_TAIL)
            whole = tail.rfind(b"\n") + 1
            self._offset = start + (whole if whole or not start else len(tail))  # a line longer than that is skipped

    def poll(self) -> list[Event]:
        """Return the events since the last call. Unknown kinds and incomplete events are left out."""
        self.is_behind = False
        try:
            with open_plain(self._path, follow_link=False) as file:
                size = os.fstat(file.fileno()).st_size
                if size < self._offset:  # another file replaced it
                    self._offset = 0
                file.seek(self._offset)
                most = MOST_BYTES if self._hurried else MOST_AT_ONCE
                content = file.read(most)
                if self._hurried and len(content) == MOST_BYTES and b"\n" not in content:  # a long answer
                    most = LONGEST_ANSWER
                    content += file.read(most - MOST_BYTES)
        except FileNotFoundError:
            return []
        whole = content.rfind(b"\n") + 1 or (len(content) if len(content) == most else 0)  # too long for an event
        self._offset += whole
        self.is_behind = whole > 0 and self._offset < size
        lines = content[:whole].splitlines()
        if self._hurried:
            pairs = pairwise([*lines, b""])  # progress that the next line supersedes is left out
            lines = [line for line, following in pairs if not (_PROGRESS in line and _PROGRESS in following)]
        return _parsed(lines)


def last_run(path: Path) -> list[Event]:
    """Return the events of the latest run, from its hello on; none if no run began."""
    return _since_hello(EventReader(path).poll())


def echoed(line: bytes, descriptor: int) -> bool:
    """Write the line to the descriptor and return whether all of it was written: False if nobody reads it any more."""
    try:
        while line:
            line = line[os.write(descriptor, line) :]
    except OSError:
        return False
    return True


def at_work(path: Path) -> PlgsError:
    """The error for an events file that a process has locked. It names the process, its machine and its start."""
    try:
        hello = next((event for event in last_run(path) if event.kind == "hello"), None)
    except (OSError, PlgsError):  # a lock is valid even if its events cannot be read
        hello = None
    who = ""
    if hello is not None:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(hello.time))
        who = f" (process {hello.data.get('pid')} on {hello.data.get('machine', 'an unnamed machine')}, since {since})"
    fix = "Wait until it is done, or create a file named 'cancel' there to stop it; end the process if it hangs."
    return PlgsError("at-work", f"another engine is at work here{who}", path.parent, fix, code=ErrorCode.BUSY)


def last_events(path: Path) -> list[Event]:
    """Return the last events of the latest run, enough to see how it ended. Only the end of the file is read. An error
    is the last event of a run, or the second to last if the engine was cancelled meanwhile."""
    try:
        start, tail = _tail(path, TAIL_BYTES)
    except FileNotFoundError:
        return []
    events = _parsed(tail.splitlines())
    if start and not events:  # a power cut can leave such an end
        events = _parsed(_tail(path, LONGEST_TAIL)[1].splitlines())
    return _since_hello(events)


def _since_hello(events: list[Event]) -> list[Event]:
    hellos = [index for index, event in enumerate(events) if event.kind == "hello"]
    return events[hellos[-1] :] if hellos else events


def _tail(path: Path, size: int) -> tuple[int, bytes]:
    """Return the last ``size`` bytes of a file, and at which byte they begin. Raises OSError."""
    with open_plain(path, follow_link=False) as file:
        start = max(0, os.fstat(file.fileno()).st_size - size)
        file.seek(start)
        return start, file.read(size)


def _parsed(lines: Iterable[bytes]) -> list[Event]:
    """Parse the events of known kinds with all their keys. Other lines, as a power cut leaves, are ignored."""
    events = []
    for line in lines:
        try:
            fields = json.loads(line)
            event = Event(int(fields.pop("seq")), float(fields.pop("time")), str(fields.pop("event")), fields)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            continue
        if event.kind in _KEYS and _KEYS[event.kind] <= event.data.keys():
            events.append(event)
    return events
