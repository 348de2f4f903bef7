"""Threads that run compiled kernels side by side.

Kernels release the interpreter's lock, so plain Python threads are enough: they need no threading layer of
Numba's (none of which is both on every system and safe to call from several threads), do not spin for long while they
wait, and compile far faster.
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

from .bell import LOOKS, listen, new_bell

Kernel = Callable[..., None]
Calls = tuple[tuple[Kernel, tuple[Any, ...]], ...]
"""Kernels and their arguments, but for the first two."""


class _Helper:
    """A thread and its inbox. ``called`` rings when something was put there, ``finished`` when a kernel is done."""

    def __init__(self, name: str) -> None:
        self.inbox: SimpleQueue[Any] = SimpleQueue()
        self.called, self.finished = new_bell(), new_bell()
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def start(self, job: tuple[Any, ...]) -> None:
        self.inbox.put(job)
        self.called[0] += 1

    def _work(self) -> None:
        heard = 0
        while True:
            listen(self.called, heard, LOOKS)
            worker, workers, calls, done = self.inbox.get()
            heard += 1
            mistake: BaseException | None = None
            try:
                _run(worker, workers, calls)
            except BaseException as error:  # handed to the caller, who raises it
                mistake = error
            del calls
            done.put(mistake)
            self.finished[0] += 1


_helpers: list[_Helper] = []
_owner = 0
_growing = threading.Lock()
_stopwatch: dict[str, float] | None = None


def worker_count() -> int:
    """As many workers as torch has threads."""
    return max(1, torch.get_num_threads())


def share(workers: int, kernel: Kernel, *arguments: Any) -> None:
    """Call ``kernel(worker, workers, *arguments)`` for every worker, on a thread each, and wait for all of
    them.

    The first call of a kernel runs here alone, worker after worker: it compiles. Raises what a worker raised.
    """
    share_all(workers, (kernel, arguments))


def share_all(workers: int, *calls: tuple[Kernel, tuple[Any, ...]]) -> None:
    """As ``share`` of each of these kernels with its arguments, but nobody waits for the others in between."""
    start = time.perf_counter()
    _share(workers, calls)
    if _stopwatch is not None:
        name = " and ".join(kernel.__name__ for kernel, _ in calls)
        _stopwatch[name] = _stopwatch.get(name, 0.0) + time.perf_counter() - start


@contextmanager
def timed() -> Iterator[dict[str, float]]:
    """Within, the wall seconds of every kernel add up under its name; of several called at once, under all of
    them."""
    global _stopwatch
    _stopwatch = {}
    try:
        yield _stopwatch
    finally:
        _stopwatch = None


def _run(worker: int, workers: int, calls: Calls) -> None:
    for kernel, arguments in calls:
        kernel(worker, workers, *arguments)


def _share(workers: int, calls: Calls) -> None:
    if workers == 1 or not all(getattr(kernel, "overloads", None) for kernel, _ in calls):
        for worker in range(workers):
            _run(worker, workers, calls)
        return
    _grow(workers - 1)
    helpers = _helpers[: workers - 1]
    heard = [int(helper.finished[0]) for helper in helpers]
    done: SimpleQueue[BaseException | None] = SimpleQueue()
    for worker, helper in enumerate(helpers, start=1):
        helper.start((worker, workers, calls, done))
    mistakes: list[BaseException | None] = []
    try:
        _run(0, workers, calls)
    finally:
        # the arrays must not go while others write to them
        for helper, rings in zip(helpers, heard, strict=True):
            listen(helper.finished, rings, LOOKS)
        mistakes = [done.get() for _ in helpers]
    for mistake in mistakes:
        if mistake is not None:
            raise mistake


def _grow(count: int) -> None:
    """At least ``count`` helper threads; a forked process starts its own."""
    global _owner
    if _owner == os.getpid() and len(_helpers) >= count:
        return
    with _growing:
        if _owner != os.getpid():
            _helpers.clear()
            _owner = os.getpid()
        while len(_helpers) < count:
            _helpers.append(_Helper(f"plgs-worker-{len(_helpers) + 1}"))
