"""Run compiled kernels in parallel in Python's own thread pool, as kernels release the interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch

MOST_WORKERS = 256


def worker_count() -> int:
    """Return the number of torch's threads, at most ``MOST_WORKERS``."""
    return max(1, min(torch.get_num_threads(), MOST_WORKERS))


@contextmanager
def two_torch_threads() -> Iterator[None]:
    """Limit torch to two threads: for a few thousand rows, waking more takes longer than the work."""
    before = torch.get_num_threads()
    torch.set_num_threads(min(before, 2))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def parallel_for(workers: int, kernel: Callable[..., None], *arguments: Any) -> None:
    """Run ``kernel(worker, workers, *arguments)`` for worker 0, 1, ... ``workers`` - 1, and wait for all of them. The
    calling thread is worker 0. A kernel must not call `parallel_for`. Raises ``ValueError`` if ``workers`` is not
    between 1 and ``MOST_WORKERS``, and whatever a kernel raised, after all workers have ended."""
    if not 1 <= workers <= MOST_WORKERS:
        raise ValueError(f"{workers} workers were requested; there can be 1 to {MOST_WORKERS}")
    others = [_pool().submit(kernel, worker, workers, *arguments) for worker in range(1, workers)]
    try:
        kernel(0, workers, *arguments)
    finally:
        wait(others)
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the thread pool of this process. It starts another thread when a kernel needs one."""
    return ThreadPoolExecutor(MOST_WORKERS, thread_name_prefix="plgs-worker")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process does not have the threads
