"""Kernels with one thread per worker: all of them run, errors are raised, and nobody returns early."""

import os
import signal
import sys
import threading
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from engine.machine.compiled import machine_target, parallel_kernel
from engine.machine.threads import MOST_WORKERS, parallel_for


class Pair(NamedTuple):
    values: NDArray[np.float32]
    factor: float


@parallel_kernel
def write_numbers(worker: int, workers: int, numbers: NDArray[Any], at_fault: int) -> None:
    if worker == at_fault:
        raise ValueError("this worker fails")
    numbers[worker] = 10 * workers + worker


def toil_at(worker: int, workers: int, numbers: NDArray[Any], toil: int) -> None:
    """All workers but the first take long."""
    value = np.int64(worker)
    for _ in range(toil if worker > 0 else 0):
        value = (value * 1_103_515_245 + 12_345) % 2_147_483_648 ^ (value >> 7)  # no compiler foresees it
    numbers[worker] = value


toil_at_numbers = parallel_kernel(toil_at)


@parallel_kernel
def sum_all(worker: int, workers: int, matrix: Any, pair: Any, nested: Any, out: NDArray[Any]) -> None:
    out[worker] = pair.factor * (matrix.sum() + pair.values.sum() + nested[0] * nested[1][0].sum())


@parallel_kernel
def multiply_add(worker: int, workers: int, a: Any, out: NDArray[np.float32]) -> None:
    out[0] = a[0] * a[1] - a[2]


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_parallel_for_runs_every_worker_once(workers: int) -> None:
    for _ in range(20):
        numbers = np.full(6, -1, np.int64)
        parallel_for(workers, write_numbers, numbers, -1)
        assert numbers.tolist() == [10 * workers + worker for worker in range(workers)] + [-1] * (6 - workers)


@pytest.mark.parametrize("at_fault", [0, 2])
def test_a_workers_error_is_raised_after_all_workers_have_ended(at_fault: int) -> None:
    numbers = np.zeros(3, np.int64)
    with pytest.raises(ValueError, match="this worker fails"):
        parallel_for(3, write_numbers, numbers, at_fault)
    assert np.count_nonzero(numbers) == 2
    parallel_for(3, write_numbers, numbers, -1)
    assert numbers.tolist() == [30, 31, 32]


def test_parallel_for_waits_for_slow_workers() -> None:
    expected, numbers = np.zeros(4, np.int64), np.zeros(4, np.int64)
    for worker in range(4):
        toil_at(worker, 4, expected, 1000)  # in Python
    parallel_for(4, toil_at_numbers, numbers, 1000)
    assert np.array_equal(numbers, expected)
    for _ in range(3):
        numbers[:] = -1
        parallel_for(4, toil_at_numbers, numbers, 5_000_000)
        assert (numbers >= 0).all()


def test_parallel_for_can_be_called_from_several_threads() -> None:
    wrong: list[list[int]] = []

    def call(workers: int) -> None:
        for _ in range(200):
            numbers = np.full(workers, -1, np.int64)
            parallel_for(workers, write_numbers, numbers, -1)
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
def test_a_forked_process_has_threads_of_its_own() -> None:
    parallel_for(2, write_numbers, np.zeros(2, np.int64), -1)
    child = os.fork()
    if child == 0:
        try:
            signal.alarm(20)
            numbers = np.zeros(2, np.int64)
            parallel_for(2, write_numbers, numbers, -1)
            os._exit(0 if numbers.tolist() == [20, 21] else 1)
        finally:
            os._exit(2)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("workers", [-1, 0, MOST_WORKERS + 1])
def test_an_impossible_number_of_threads_is_refused(workers: int) -> None:
    with pytest.raises(ValueError, match=f"{workers} workers were requested"):
        parallel_for(workers, write_numbers, np.zeros(1, np.int64), -1)


def test_arguments_reach_kernels_and_are_released_afterwards() -> None:
    random = np.random.default_rng(3)
    strided, values = random.random((8, 6))[::2, 1::3], random.random(5, np.float32)
    bytes_ = np.arange(7, dtype=np.uint8)
    out = np.zeros(1)
    before = sys.getrefcount(values)
    parallel_for(1, sum_all, strided, Pair(values, 0.5), (3, (bytes_,)), out)
    assert out[0] == pytest.approx(0.5 * (strided.sum() + values.sum() + 3 * 21))
    assert sys.getrefcount(values) == before


@pytest.mark.skipif("+fma" not in machine_target()[2], reason="no fused multiply-add here")
def test_kernels_round_a_product_before_adding_to_it() -> None:
    """(1 + e)^2 - (1 + 2 e) is e^2, which is lost if the product is rounded."""
    e = np.float32(2.0**-13)
    a, out = np.array([1 + e, 1 + e, 1 + 2 * e], np.float32), np.ones(1, np.float32)
    parallel_for(1, multiply_add, a, out)
    assert out[0] == 0.0
