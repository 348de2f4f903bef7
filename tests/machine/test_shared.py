"""What shared kernels take, and how they are compiled."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from engine.machine.blackboard import CALL_ROWS, WORDS, new_board
from engine.machine.compiled import machine_target
from engine.machine.shared import shared, shared_contracted


class Pair(NamedTuple):
    values: NDArray[np.float32]
    factor: float


@shared
def sum_all(
    worker: int, workers: int, matrix: Any, strided: Any, pair: Any, nested: Any, flag: bool, out: NDArray[Any]
) -> None:
    out[worker] = pair.factor * (matrix.sum() + strided.sum() + pair.values.sum() + nested[0] * nested[1][0].sum())
    if flag:
        out[worker] += np.arange(workers).sum()


@shared
def do_nothing(worker: int, workers: int, anything: Any) -> None:
    pass


@shared
def multiply_add(worker: int, workers: int, a: Any, out: NDArray[np.float32]) -> None:
    out[0] = a[0] * a[1] - a[2]


@shared_contracted
def contracted_multiply_add(worker: int, workers: int, a: Any, out: NDArray[np.float32]) -> None:
    out[0] = a[0] * a[1] - a[2]


def test_arrays_numbers_and_tuples_of_them_arrive() -> None:
    random = np.random.default_rng(3)
    matrix, strided = random.random((3, 4)), random.random((8, 6))[::2, 1::3]
    values, bytes_ = random.random(5, np.float32), np.arange(7, dtype=np.uint8)
    out = np.zeros(1)
    assert sum_all(new_board(), 1, (matrix, strided, Pair(values, 0.5), (3, (bytes_,)), True, out))
    assert out[0] == pytest.approx(0.5 * (matrix.sum() + strided.sum() + values.sum() + 3 * 21))


def test_nobody_keeps_the_arrays() -> None:
    values = np.zeros(3)
    before = sys.getrefcount(values)
    do_nothing(new_board(), 1, (values,))
    assert sys.getrefcount(values) == before


@pytest.mark.skipif("+fma" not in machine_target()[2], reason="no fused multiply-add here")
def test_only_the_contracted_are_fused() -> None:
    """(1 + e)^2 - (1 + 2 e) is e^2, which a product that is rounded loses."""
    e = np.float32(2.0**-13)
    a, out = np.array([1 + e, 1 + e, 1 + 2 * e], np.float32), np.zeros(1, np.float32)
    multiply_add(new_board(), 1, (a, out))
    assert out[0] == 0.0
    contracted_multiply_add(new_board(), 1, (a, out))
    assert out[0] == e * e


def test_each_has_a_name_and_a_cache_of_its_own() -> None:
    assert (sum_all.__name__, do_nothing.__name__) == ("sum_all", "do_nothing")
    files = {kernel._cache._cache_file._index_path for kernel in (sum_all, do_nothing, multiply_add)}
    assert len(files) == 3


@pytest.mark.parametrize(
    ("argument", "words"),
    [([1, 2, 3], "kernels take numbers, arrays and tuples"), (tuple(range(WORDS * CALL_ROWS + 1)), "do not fit")],
)
def test_what_cannot_be_written_is_refused(argument: Any, words: str) -> None:
    with pytest.raises((TypeError, NumbaError), match=words):
        do_nothing(new_board(), 1, (argument,))
