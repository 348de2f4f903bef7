"""Arguments that are written on a board reach the kernel as they are."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from engine.machine.blackboard import CALL_ROWS, ROWS, WORDS, call_all, new_board
from engine.machine.compiled import compiled, part


class Pair(NamedTuple):
    values: NDArray[np.float32]
    factor: float


@part
def sum_share(
    worker: int, workers: int, matrix: Any, strided: Any, pair: Any, nested: Any, flag: bool, out: NDArray[Any]
) -> None:
    out[worker] = pair.factor * (matrix.sum() + strided.sum() + pair.values.sum() + nested[0] * nested[1][0].sum())
    if flag:
        out[worker] += np.arange(workers).sum()


@compiled
def sum_all(board: NDArray[Any], workers: int, arguments: Any) -> Any:
    return call_all(sum_share, board, workers, arguments)


@part
def nothing_share(worker: int, workers: int, anything: Any) -> None:
    pass


@compiled
def do_nothing(board: NDArray[Any], workers: int, arguments: Any) -> Any:
    return call_all(nothing_share, board, workers, arguments)


def test_arrays_numbers_and_tuples_of_them_arrive() -> None:
    random = np.random.default_rng(3)
    matrix, strided = random.random((3, 4)), random.random((8, 6))[::2, 1::3]
    values, bytes_ = random.random(5, np.float32), np.arange(7, dtype=np.uint8)
    out = np.zeros(1)
    assert sum_all(new_board(), 1, (matrix, strided, Pair(values, 0.5), (3, (bytes_,)), True, out))
    assert out[0] == pytest.approx(0.5 * (matrix.sum() + strided.sum() + values.sum() + 3 * 21))


def test_a_board_has_whole_cache_lines() -> None:
    board = new_board()
    assert board.shape == (ROWS, WORDS) and board.ctypes.data % 64 == 0 and not board.any()


@pytest.mark.parametrize(
    ("argument", "words"),
    [([1, 2, 3], "kernels take numbers, arrays and tuples of them"), (tuple(range(8 * CALL_ROWS + 1)), "do not fit")],
)
def test_what_cannot_be_written_is_refused(argument: Any, words: str) -> None:
    with pytest.raises((TypeError, NumbaError), match=words):
        do_nothing(new_board(), 1, (argument,))
