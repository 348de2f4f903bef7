"""Threads that run compiled kernels side by side.

They need no threading layer of Numba's (none of which is both on every system and safe to call from several threads),
do not spin for long while they wait, and compile far faster. ``blackboard`` tells how a call reaches them.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import torch
from numba import typeof

from .blackboard import CALLED, LOOKS, MOST_WORKERS, STATUS, all_finished, new_board, serve
from .shared import Kernel
from .undisturbed import undisturbed

NAP = 1e-4
"""Seconds between looks when others take much longer than the caller."""

_stopwatch: dict[str, float] | None = None


def worker_count() -> int:
    """As many workers as torch has threads, ``MOST_WORKERS`` at most."""
    return max(1, min(torch.get_num_threads(), MOST_WORKERS))


def share(workers: int, kernel: Kernel, *arguments: Any) -> None:
    """Have the kernel done by so many workers (1 to ``MOST_WORKERS``), on a thread each, and wait for all of them.

    One call at a time: of several threads each waits until the kernel of the one before is done, and a kernel cannot
    call this. Raises ``ValueError`` on a number of workers that cannot be, and ``RuntimeError`` when compiled code
    raised in a worker; what it said is lost.
    """
    if not 1 <= workers <= MOST_WORKERS:
        raise ValueError(f"{workers} workers are asked for; there can be 1 to {MOST_WORKERS}")
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
        self._board = new_board()
        self._helpers: list[_Helper] = []
        self._turn = threading.Lock()
        # compiled, or loaded, now: when a helper needs them others wait for it
        undisturbed(serve, self._board, 1, 0, 0)
        undisturbed(all_finished, self._board, 1, 0)

    def run(self, workers: int, kernel: Any, arguments: tuple[Any, ...]) -> None:
        with self._turn:
            self._hire(workers - 1)
            if not kernel.overloads:  # helpers to whom a call is announced would look for it all the while
                undisturbed(kernel.compile, tuple(map(typeof, (self._board, workers, arguments))))
            called = self._helpers[: workers - 1]
            finished = False
            try:
                for helper in called:
                    helper.announce()
                finished = kernel(self._board, workers, arguments)
            finally:
                try:
                    if not finished:
                        self._wait(workers)
                finally:
                    for helper in called:
                        helper.settle()
            failed = [worker for worker in range(workers) if self._board[2 * worker + 1, STATUS]]
        if failed:
            raise RuntimeError(f"worker {failed[0]} of {workers} failed in the kernel {kernel.__name__}")

    def _hire(self, count: int) -> None:
        """So many helpers at least. An interrupt may leave a thread that nobody knows of: it is left alone with its
        board, and all begin anew at another."""
        try:
            while len(self._helpers) < count:
                self._helpers.append(_Helper(self._board, len(self._helpers) + 1))
        except BaseException:
            self._board, self._helpers = new_board(), []
            raise

    def _wait(self, workers: int) -> None:
        """The arrays must not go while others write to them, whoever wants to interrupt, and how often."""
        interrupt: BaseException | None = None
        while True:
            try:
                while not all_finished(self._board, workers, 0):
                    time.sleep(NAP)
                break
            except BaseException as error:  # a signal's; raised when all is done
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

    def settle(self) -> None:
        """No call comes any more, whether one came or something went wrong after its announcement."""
        self._announced = int(self._board[2 * self._worker, CALLED])

    def _serve(self) -> None:
        calls = 0
        while True:
            calls = serve(self._board, self._worker, calls, LOOKS)
            self._asleep = True
            if calls == self._announced:
                self._alarm.get()
            self._asleep = False


_hired: _Crew | None = None
_hiring = threading.Lock()


def _crew() -> _Crew:
    """That of this process."""
    global _hired
    if _hired is None:
        with _hiring:
            if _hired is None:
                _hired = _Crew()
    return _hired


def _start_anew() -> None:
    """Threads do not follow into a forked process, which hires its own; locks may be held there for ever."""
    global _hired, _hiring
    _hired, _hiring = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_anew)
