"""How a lift is stopped: by the cancel file, by a signal, or by the end of the process that started it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from .errors import Cancelled
from .events import EventWriter
from .exit_code import ExitCode

POLL_S = 0.1
GRACE_S = 0.5
"""From the request to the hard end. With the poll, and the process's own end, that is within a second."""


class StopSignal:
    """Asked by the engine's loops at every step: ``stop.check()``."""

    def __init__(self, *cancel_paths: Path) -> None:
        """Any of the files ``cancel_paths`` stops it."""
        self._cancel_paths = cancel_paths
        self._reason: str | None = None
        self.exit_code = ExitCode.CANCELLED

    def check(self) -> None:
        """Raise Cancelled when the lift shall stop. Costs some microseconds."""
        reason = self.reason
        if reason is not None:
            raise Cancelled(reason)

    @property
    def reason(self) -> str | None:
        """Why the lift shall stop; None when it shall go on."""
        if self._reason is None:
            for path in self._cancel_paths:
                if _is_there(path):
                    self._reason = f"the file '{path.name}' is there"
        return self._reason

    def ask(self, reason: str, exit_code: ExitCode = ExitCode.CANCELLED) -> None:
        """Make the next check raise, and the process end with this code."""
        self.exit_code = exit_code
        self._reason = reason


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a disk that does not answer now (EIO, ESTALE): the next look tells
        return False


class Watchdog:
    """Ends the engine when its main thread does not stop in time. For ``with``, around the whole lift.

    Threads are allowed here: this is the engine's own process, not Blender's Python, and these two never touch
    the lift's data. One polls the cancel file; the other waits for the end of the pipe ``parent_pipe`` (a
    descriptor, its write end held by the parent and by nobody else): it comes when the parent ends, in whatever
    way, on every system. The hard end is safe because all in a lift folder is put in place by rename. It has to
    wait while the main thread is inside native code that holds Python's lock; a parent then kills (`follower`).
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
        _await_end(self._parent_pipe)
        self._stop.ask("the process that started the engine is gone")
        self._asked.set()

    def _watch(self) -> None:
        while self._stop.reason is None:
            if self._over.is_set():
                return
            self._asked.wait(POLL_S)
        if not self._over.wait(self._grace_s):
            with suppress(OSError):  # a full disk does not keep the engine alive
                self._events.done("cancelled")
            self._end_process(self._stop.exit_code)


def end_with_parent(parent_pipe: int, end_process: Callable[[int], object] = os._exit) -> None:
    """End this process when the pipe ends, as ``Watchdog`` does, but at once: for work that may end at any time, as
    all its files are put in place by rename, or made anew.
    """

    def end() -> None:
        _await_end(parent_pipe)
        end_process(ExitCode.CANCELLED)

    threading.Thread(target=end, name="plgs-parent", daemon=True).start()


def _await_end(pipe: int) -> None:
    while os.read(pipe, 4096):
        pass
