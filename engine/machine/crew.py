"""Threads that run compiled kernels side by side.

They need no threading layer of Numba's (none of which is both on every system and safe to call from several threads),
do not spin for long while they wait, and compile far faster. ``blackboard`` tells how a call reaches them.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import torch
from numba import typeof

from .blackboard import CALLED, LOOKS, MOST_WORKERS, STATUS, all_finished, new_board, serve
from .frames import with_room

Kernel = Callable[..., Any]
"""A compiled function of a board, a number of workers and a tuple of arguments; returns what ``call_all`` does."""
NAP = 1e-4
"""Seconds between looks when others take much longer than the caller."""

_stopwatch: dict[str, float] | None = None


def worker_count() -> int:
    """As many workers as torch has threads."""
    return max(1, min(torch.get_num_threads(), MOST_WORKERS))


def share(workers: int, kernel: Kernel, *arguments: Any) -> None:
    """Have the kernel done by so many workers, on a thread each, and wait for all of them.

    Several threads may call this; they wait for each other. Raises ``RuntimeError`` when a worker failed, which
    kernels do not do by themselves: only compiled code that raises does.
    """
    start = time.perf_counter()
    _crew().run(workers, kernel, arguments)
    if _stopwatch is not None:
        name = kernel.__name__
        _stopwatch[name] = _stopwatch.get(name, 0.0) + time.perf_counter() - start


@contextmanager
def timed() -> Iterator[dict[str, float]]:
    """Within, the wall seconds of every kernel add up under its name."""
    global _stopwatch
    _stopwatch = {}
    try:
        yield _stopwatch
    finally:
        _stopwatch = None


class _Crew:
    """The helpers of one process, and their board."""

    def __init__(self) -> None:
        self.process = os.getpid()
        self._board = new_board()
        self._helpers: list[_Helper] = []
        self._turn = threading.Lock()
        # compiled, or loaded, now: when a helper needs them others wait for it
        serve(self._board, 1, 0, 0)
        all_finished(self._board, 1, 0)

    def run(self, workers: int, kernel: Any, arguments: tuple[Any, ...]) -> None:
        with self._turn:
            while len(self._helpers) < workers - 1:
                self._helpers.append(_Helper(self._board, len(self._helpers) + 1))
            if not kernel.overloads:  # helpers that are awake would wait for the compiler
                with_room(kernel.compile, tuple(map(typeof, (self._board, workers, arguments))))
            called = self._helpers[: workers - 1]
            finished = False
            try:
                for helper in called:
                    helper.announce()
                finished = kernel(self._board, workers, arguments)
            finally:
                if not finished:
                    self._wait(workers)
                for helper in called:
                    helper.has_been_called()
            failed = [worker for worker in range(workers) if self._board[2 * worker + 1, STATUS]]
        if failed:
            raise RuntimeError(f"worker {failed[0]} of {workers} failed in the kernel {kernel.__name__}")

    def _wait(self, workers: int) -> None:
        """The arrays must not go while others write to them, whoever wants to interrupt."""
        interrupt: KeyboardInterrupt | None = None
        while not all_finished(self._board, workers, 0):
            try:
                time.sleep(NAP)
            except KeyboardInterrupt as error:
                interrupt = error
        if interrupt is not None:
            raise interrupt


class _Helper:
    """A thread that serves at a board, and falls asleep when no call is on its way. The interpreter's lock orders what
    the two threads see of ``_announced`` (calls, by now) and ``_asleep``."""

    def __init__(self, board: Any, worker: int) -> None:
        self._board, self._worker = board, worker
        self._announced = 0
        self._asleep = False
        self._alarm: SimpleQueue[None] = SimpleQueue()
        threading.Thread(target=self._serve, name=f"plgs-worker-{worker}", daemon=True).start()

    def announce(self) -> None:
        """A call comes at once."""
        self._announced += 1
        if self._asleep:
            self._alarm.put(None)

    def has_been_called(self) -> None:
        """Or has not, where something went wrong after the announcement."""
        self._announced = int(self._board[2 * self._worker, CALLED])

    def _serve(self) -> None:
        calls = 0
        while True:
            calls = serve(self._board, self._worker, calls, LOOKS)
            self._asleep = True
            if calls == self._announced:
                self._alarm.get()
            self._asleep = False


_only: _Crew | None = None
_hiring = threading.Lock()


def _crew() -> _Crew:
    """That of this process; a forked one hires its own."""
    global _only
    crew = _only
    if crew is None or crew.process != os.getpid():
        with _hiring:
            crew = _only
            if crew is None or crew.process != os.getpid():
                crew = _only = _Crew()
    return crew
