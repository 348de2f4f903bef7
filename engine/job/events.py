"""events.jsonl: what the engine tells whoever watches. One JSON object a line, written at once."""

from __future__ import annotations

import json
import os
import platform
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from .. import __version__
from ..gates import open_plain, open_to_append
from .json_file import Json, to_line

_KEYS: Mapping[str, frozenset[str]] = {
    "hello": frozenset(),
    "stage": frozenset({"name", "index", "count", "label"}),
    "progress": frozenset({"step", "steps"}),
    "metric": frozenset({"name", "values"}),
    "preview": frozenset({"path"}),
    "artifact": frozenset({"path", "kind"}),
    "warning": frozenset({"message"}),
    "error": frozenset({"what", "where", "fix"}),
    "done": frozenset({"state"}),
}
"""The kinds of events, and what whoever reads one may count on."""
TAIL_BYTES = 16384
"""The last lines of a run, and none of them is near as long."""
LONGEST_TAIL = 1 << 20
"""What is looked at where those hold no event: a file of somebody else's may hold anything."""
MOST_AT_ONCE = 1 << 26
"""What is read at a time, in any case: as much as months of lifting tell."""
MOST_BYTES = 1 << 17
"""What a hurried reader takes at a time: a millisecond of reading, and an hour's events are caught up in seconds."""
MOST_CAUGHT_UP = 1 << 24
"""Of what was told before it looked, a hurried reader takes so much at most."""
_PROGRESS = b'"event": "progress"'


@dataclass(frozen=True)
class Event:
    """One line: ``seq`` rises by one, ``time`` is Unix seconds, ``data`` the rest (see EventWriter)."""

    seq: int
    time: float
    kind: str
    data: Mapping[str, Json]


class EventWriter:
    """Appends events; only the engine does, while it holds the folder's lock. Safe in several threads.

    ``seq`` goes on where an earlier run ended; a line that a kill tore in two is cut off first. Raises
    OSError when the disk is full.
    """

    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        self._lock = threading.Lock()
        self._done = False
        self._began = time.monotonic()
        self._torn = False
        self._descriptor = open_to_append(path)
        self._seq = self._repair(path)

    def _repair(self, path: Path) -> int:
        """Cut a torn last line off and return the highest ``seq`` of the last lines; an end without lines is left."""
        start, content = _tail(path, LONGEST_TAIL)
        whole = content.rfind(b"\n") + 1
        self._torn = start > 0 and not whole
        if whole < len(content) and not self._torn:
            os.ftruncate(self._descriptor, whole)
        return max((event.seq for event in _parse(content[:whole])), default=0)

    def hello(self, *, threads: int, resumed: bool, task: str | None = None) -> None:
        """A run begins. ``threads``: how many compute threads it may use; ``task``: what is done when it is no lift."""
        about = {"engine_version": __version__, "pid": os.getpid(), "python": platform.python_version()}
        what = {} if task is None else {"task": task}
        self._write("hello", **about, threads=threads, resumed=resumed, **what)

    def stage(self, name: str, index: int, count: int, label: str) -> None:
        """Stage ``index`` (from 1) of ``count`` begins; ``label`` is for people."""
        self._write("stage", name=name, index=index, count=count, label=label)

    def progress(
        self, stage: str, step: int, steps: int, *, loss: float | None = None, eta_s: float | None = None
    ) -> None:
        """``step`` of ``steps`` of a stage is done; ``eta_s`` seconds of it remain."""
        self._write("progress", stage=stage, step=step, steps=steps, loss=loss, eta_s=eta_s)

    def metric(self, name: str, values: Mapping[str, float | int | str | None]) -> None:
        """Figures that belong together, such as one row of the end table."""
        self._write("metric", name=name, values=values)

    def preview(self, path: Path, camera: str = "") -> None:
        """A picture worth showing was written; ``camera`` is the fingerprint of the one that a watcher asked for."""
        self._write("preview", path=self._relative(path), **({"camera": camera} if camera else {}))

    def artifact(self, path: Path, kind: str) -> None:
        """A file of the result was written."""
        self._write("artifact", path=self._relative(path), kind=kind)

    def warning(self, message: str) -> None:
        """Something a user should know; the lift goes on."""
        self._write("warning", message=message)

    def error(self, what: str, where: Path | str, fix: str, exit_code: int) -> None:
        """The run ends because of this."""
        self._write("error", what=what, where=str(where), fix=fix, exit_code=int(exit_code))

    def done(self, state: str) -> None:
        """The run is over, "finished" or "cancelled". What comes after the first call is dropped."""
        self._write("done", state=state, seconds=round(time.monotonic() - self._began, 3))

    def close(self) -> None:
        """Write no more. The descriptor is closed."""
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
            self._seq += 1
            self._done = event == "done"

    def _append(self, line: bytes) -> None:
        """Raises OSError, on a full disk above all; the half of a line that was written is then taken back, so that it
        does not swallow the next.
        """
        start, written = os.fstat(self._descriptor).st_size, 0
        try:
            while written < len(line):
                written += os.write(self._descriptor, line[written:])
        except OSError:
            if written:
                self._torn = True
                os.ftruncate(self._descriptor, start)
                self._torn = line.startswith(b"\n")
            raise
        self._torn = False

    def _relative(self, path: Path) -> str:
        """Paths inside the lift folder are told relative to it, so that the folder can be moved."""
        inside = path.is_relative_to(self._folder)
        return (path.relative_to(self._folder) if inside else path).as_posix()


class EventReader:
    """Follows an events file that another process appends to.

    Its position is always the end of a whole line: a line that is still being written is read again later,
    and one that a later run cuts off was never seen. ``from_end``: leave out what is there already. ``hurried``:
    read no more than MOST_BYTES at a time (``is_behind`` tells whether there is more), and of progress events that
    follow one another only the last, so that a call takes a window's loop no time to speak of. Raises OSError.
    """

    def __init__(self, path: Path, *, from_end: bool = False, hurried: bool = False) -> None:
        self._path, self._offset, self._hurried = path, 0, hurried
        self.is_behind = False
        if hurried:
            self._offset = max(0, _size(path) - MOST_CAUGHT_UP)  # what is torn there is no event
        if from_end and path.exists():
            start, tail = _tail(path, LONGEST_TAIL)
            whole = tail.rfind(b"\n") + 1
            self._offset = start + (whole if whole or not start else len(tail))

    def poll(self) -> list[Event]:
        """The events since the last call; unknown kinds, and lines that are no whole event, are left out."""
        self.is_behind = False
        try:
            with open_plain(self._path, follow_link=False) as file:
                size = os.fstat(file.fileno()).st_size
                if size < self._offset:  # another file took its place
                    self._offset = 0
                file.seek(self._offset)
                most = MOST_BYTES if self._hurried else MOST_AT_ONCE
                content = file.read(most)
        except FileNotFoundError:
            return []
        whole = content.rfind(b"\n") + 1 or (len(content) if len(content) == most else 0)  # no event is so long
        self._offset += whole
        self.is_behind = whole > 0 and self._offset < size
        lines = content[:whole].splitlines()
        if self._hurried:
            lines = _without_outdated(lines)
        return _usable(_parsed(lines))


def _without_outdated(lines: list[bytes]) -> list[bytes]:
    """The lines but for progress that the next line brings up to date."""
    is_progress = [_PROGRESS in line for line in lines] + [False]
    return [line for place, line in enumerate(lines) if not (is_progress[place] and is_progress[place + 1])]


def last_run(path: Path) -> list[Event]:
    """The events of the latest run: from the last hello on. Empty when no run began."""
    events = EventReader(path).poll()
    for index in range(len(events) - 1, -1, -1):
        if events[index].kind == "hello":
            return events[index:]
    return events


def last_events(path: Path) -> list[Event]:
    """The last events of the latest run, read from the end of the file alone: enough to tell how the run ended.

    An error is the last event of a run, or the last but the ``done`` of an engine that was cancelled meanwhile.
    """
    try:
        start, tail = _tail(path, TAIL_BYTES)
    except FileNotFoundError:
        return []
    events = _usable(_parse(tail))
    if start and not events:  # what a power cut left of the end
        events = _usable(_parse(_tail(path, LONGEST_TAIL)[1]))
    for index in range(len(events) - 1, -1, -1):
        if events[index].kind == "hello":
            return events[index:]
    return events


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _tail(path: Path, size: int) -> tuple[int, bytes]:
    """The last ``size`` bytes of a file, and where they begin. Raises OSError."""
    with open_plain(path, follow_link=False) as file:
        start = max(0, os.fstat(file.fileno()).st_size - size)
        file.seek(start)
        return start, file.read(size)


def _parse(content: bytes) -> list[Event]:
    return _parsed(content.splitlines())


def _usable(events: Iterable[Event]) -> list[Event]:
    """Those of kinds that are known, with all that belongs to them."""
    return [event for event in events if event.kind in _KEYS and _KEYS[event.kind] <= event.data.keys()]


def _parsed(lines: Iterable[bytes]) -> list[Event]:
    events = []
    for line in lines:
        try:
            fields = json.loads(line)
            event = Event(int(fields.pop("seq")), float(fields.pop("time")), str(fields.pop("event")), fields)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            continue  # what a power cut left of a line: the other lines still count
        events.append(event)
    return events
