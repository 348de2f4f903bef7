"""How a task is stopped: by its cancel file, by a signal, or by the end of the process that started it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ..errors import Cancelled, ExitCode
from .events import EventWriter

POLL_S = 0.1
"""Seconds between two checks of the cancel file."""
GRACE_S = 0.5
"""Seconds from the request to the forced end. With the poll and the process's exit, it all takes less than a second."""


class StopSignal:
    """The engine's loops call ``stop.check()`` in every step."""

    def __init__(self, *cancel_paths: Path) -> None:
        """Any of the files ``cancel_paths`` stops the task."""
        self._cancel_paths = cancel_paths
        self._reason: str | None = None
        self.exit_code = ExitCode.CANCELLED

    def check(self) -> None:
        """Raise Cancelled if the task should stop. This takes a few microseconds."""
        reason = self.reason
        if reason is not None:
            raise Cancelled(reason)

    @property
    def reason(self) -> str | None:
        """Why the task should stop; None if it should continue."""
        if self._reason is None:
            for path in self._cancel_paths:
                if _is_there(path):
                    self._reason = f"the file '{path.name}' exists"
        return self._reason

    def ask(self, reason: str, exit_code: ExitCode = ExitCode.CANCELLED) -> None:
        """Make the next check raise, and the process end with this code."""
        self.exit_code = exit_code
        self._reason = reason


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # the disk may not answer now (EIO, ESTALE); the next check will show
        return False


class Watchdog:
    """Ends the engine if its main thread does not stop in time; for ``with``, around the whole work.

    Threads are allowed here: this is the engine's own process, not Blender's Python, and the two threads never touch
    the task's data. One polls the cancel file. The other waits for the end of the pipe ``parent_pipe``, a descriptor
    whose write end only the parent holds: on every system the pipe ends when the parent does. The forced end is safe
    because all files are put in place by rename. It is impossible while the main thread is inside native code that
    holds Python's lock; then the parent kills the process (`follower`).
    """

    def __init__(
        self,
        stop: StopSignal,
        events: EventWriter,
        *,
        parent_pipe: int | None = None,
        grace_s: float = GRACE_S,
        end_process: Callable[[int], object] = os._exit,
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
        self._stop.ask("the process that started the engine is gone")
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
