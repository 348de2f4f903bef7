"""Kernels on a thread for each worker: all of them run, mistakes arrive, nobody leaves early, and the crew goes on."""

from __future__ import annotations

import os
import signal
import threading
import time
from typing import Any

import numpy as np
import pytest
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from engine.machine.blackboard import MOST_WORKERS
from engine.machine.crew import share, timed
from engine.machine.shared import shared


@shared
def write_numbers(worker: int, workers: int, numbers: NDArray[Any], at_fault: int) -> None:
    if worker == at_fault:
        raise ValueError("this worker fails")
    numbers[worker] = 10 * workers + worker


@shared
def count_runs(worker: int, workers: int, counts: NDArray[Any]) -> None:
    counts[worker] += 1


def toil_at(worker: int, workers: int, numbers: NDArray[Any], toil: int) -> None:
    """All but the first take long."""
    value = np.int64(worker)
    for _ in range(toil if worker > 0 else 0):
        value = (value * 1_103_515_245 + 12_345) % 2_147_483_648 ^ (value >> 7)  # no compiler foresees it
    numbers[worker] = value


toil_at_numbers = shared(toil_at)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_worker_does_its_share(workers: int) -> None:
    for _ in range(20):
        numbers = np.full(6, -1, np.int64)
        share(workers, write_numbers, numbers, -1)
        assert numbers.tolist() == [10 * workers + worker for worker in range(workers)] + [-1] * (6 - workers)


@pytest.mark.parametrize("seconds", [0.0, 0.001, 0.02])
def test_helpers_come_whether_they_are_awake_or_asleep(seconds: float) -> None:
    for _ in range(20):
        numbers = np.full(3, -1, np.int64)
        share(3, write_numbers, numbers, -1)
        assert numbers.tolist() == [30, 31, 32]
        time.sleep(seconds)


@pytest.mark.parametrize("at_fault", [0, 2])
def test_a_workers_mistake_is_raised_when_all_have_ended(at_fault: int) -> None:
    numbers = np.zeros(3, np.int64)
    with pytest.raises(RuntimeError, match=f"worker {at_fault} of 3 failed in the kernel write_numbers"):
        share(3, write_numbers, numbers, at_fault)
    assert np.count_nonzero(numbers) == 2
    share(3, write_numbers, numbers, -1)
    assert numbers.tolist() == [30, 31, 32]


def test_those_who_take_longer_are_waited_for() -> None:
    expected, numbers = np.zeros(4, np.int64), np.zeros(4, np.int64)
    for worker in range(4):
        toil_at(worker, 4, expected, 1000)  # in Python
    share(4, toil_at_numbers, numbers, 1000)
    assert np.array_equal(numbers, expected)
    for _ in range(3):
        numbers[:] = -1
        share(4, toil_at_numbers, numbers, 5_000_000)
        assert (numbers >= 0).all()


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs signals for one thread")
def test_an_interrupt_waits_until_nobody_writes_any_more() -> None:
    numbers = np.full(2, -1, np.int64)
    share(2, toil_at_numbers, numbers, 1)
    numbers[:] = -1
    main = threading.get_ident()
    for seconds in (0.05, 0.06, 0.08):
        threading.Timer(seconds, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        share(2, toil_at_numbers, numbers, 100_000_000)
    assert (numbers >= 0).all()
    share(2, write_numbers, numbers, -1)
    assert numbers.tolist() == [20, 21]


def test_several_threads_may_call() -> None:
    wrong: list[list[int]] = []

    def call(workers: int) -> None:
        for _ in range(200):
            numbers = np.full(workers, -1, np.int64)
            share(workers, write_numbers, numbers, -1)
            if numbers.tolist() != [10 * workers + worker for worker in range(workers)]:
                wrong.append(numbers.tolist())

    callers = [threading.Thread(target=call, args=(workers,)) for workers in (1, 2, 3, 4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert wrong == []


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_helpers_of_its_own() -> None:
    share(2, write_numbers, np.zeros(2, np.int64), -1)
    child = os.fork()
    if child == 0:
        try:
            signal.alarm(20)
            numbers = np.zeros(2, np.int64)
            share(2, write_numbers, numbers, -1)
            os._exit(0 if numbers.tolist() == [20, 21] else 1)
        finally:
            os._exit(2)
    assert os.waitpid(child, 0)[1] == 0


def test_an_interrupt_while_helpers_are_hired_leaves_no_second_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    share(2, write_numbers, np.zeros(2, np.int64), -1)
    start = threading.Thread.start

    def start_and_be_interrupted(thread: threading.Thread) -> None:
        start(thread)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", start_and_be_interrupted)
        with pytest.raises(KeyboardInterrupt):
            share(40, write_numbers, np.zeros(40, np.int64), -1)
    for _ in range(20):
        counts = np.zeros(40, np.int64)
        share(40, count_runs, counts)
        assert (counts == 1).all()


@pytest.mark.parametrize("workers", [-1, 0, MOST_WORKERS + 1])
def test_a_number_of_workers_that_cannot_be_is_refused(workers: int) -> None:
    with pytest.raises(ValueError, match=f"{workers} workers are asked for"):
        share(workers, write_numbers, np.zeros(1, np.int64), -1)


def test_helpers_sleep_even_when_an_announced_call_never_came() -> None:
    numbers = np.full(3, -1, np.int64)
    share(3, write_numbers, numbers, -1)
    with pytest.raises((TypeError, NumbaError)):
        share(3, write_numbers, [1, 2, 3], -1)
    time.sleep(0.1)
    before = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - before < 0.1
    share(3, write_numbers, numbers, -1)
    assert numbers.tolist() == [30, 31, 32]


def test_the_stopwatch_tells_kernels_apart() -> None:
    with timed() as seconds:
        share(2, write_numbers, np.zeros(2, np.int64), -1)
    share(2, write_numbers, np.zeros(2, np.int64), -1)
    assert set(seconds) == {"write_numbers"} and 0.0 < seconds["write_numbers"] < 1.0
