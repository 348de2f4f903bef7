"""Kernels on a thread for each worker: all of them run, mistakes arrive, and the crew goes on."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from engine.machine.compiled import compiled
from engine.machine.crew import share, share_all, timed


@compiled
def write_number(worker: int, workers: int, numbers: NDArray[Any], at_fault: int) -> None:
    if worker == at_fault:
        raise ValueError("this worker fails")
    numbers[worker] = 10 * workers + worker


@pytest.fixture(autouse=True)
def _is_compiled() -> None:
    share(1, write_number, np.zeros(1, np.int64), -1)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_worker_does_its_share(workers: int) -> None:
    for _ in range(20):
        numbers = np.full(6, -1, np.int64)
        share(workers, write_number, numbers, -1)
        assert numbers.tolist() == [10 * workers + worker for worker in range(workers)] + [-1] * (6 - workers)


@pytest.mark.parametrize("at_fault", [0, 2])
def test_a_workers_mistake_is_raised_when_all_have_ended(at_fault: int) -> None:
    numbers = np.zeros(3, np.int64)
    with pytest.raises(ValueError, match="this worker fails"):
        share(3, write_number, numbers, at_fault)
    assert np.count_nonzero(numbers) == 2
    share(3, write_number, numbers, -1)
    assert numbers.tolist() == [30, 31, 32]


def test_what_is_not_compiled_runs_here_alone() -> None:
    seen: list[tuple[int, bool]] = []
    main = threading.get_ident()
    share(3, lambda worker, workers: seen.append((worker, threading.get_ident() == main)))
    assert seen == [(0, True), (1, True), (2, True)]


def test_the_stopwatch_tells_kernels_apart() -> None:
    with timed() as seconds:
        share(2, write_number, np.zeros(2, np.int64), -1)
    share(2, write_number, np.zeros(2, np.int64), -1)
    assert set(seconds) == {"write_number"} and 0.0 < seconds["write_number"] < 1.0


def test_kernels_in_a_row_each_run_for_every_worker() -> None:
    first, second = np.full(3, -1, np.int64), np.full(3, -1, np.int64)
    with timed() as seconds:
        share_all(3, (write_number, (first, -1)), (write_number, (second, -1)))
    assert first.tolist() == second.tolist() == [30, 31, 32]
    assert set(seconds) == {"write_number and write_number"}
    with pytest.raises(ValueError, match="this worker fails"):
        share_all(3, (write_number, (first, 1)), (write_number, (second, -1)))
