"""A board in memory on which calls are written, and the compiled code that writes and reads it.

Python's interpreter runs one thread at a time. If every worker had to learn its arguments through it, workers would
start one after the other, and the more of them the later. Here helpers watch the board in compiled code, and run from
there what the caller wrote.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numpy.typing import NDArray

from .compiled import Array, compiled, part
from .emitting import element, intrinsic

WORDS = 8
"""Of 8 bytes in a row: a cache line, so that workers do not wait for each other's."""
MOST_WORKERS = 256
CALL = 2 * MOST_WORKERS
"""The first of the rows that hold the arguments of a call. Worker w has the rows 2 w, which the caller writes, and
2 w + 1, which the worker writes."""
CALL_ROWS = 128
"""8 KiB; the longest list of arguments takes 3."""
ROWS = CALL + CALL_ROWS

CALLED, KERNEL, WORKERS = 0, 1, 2
"""Words of a worker's first row: how often it was called, the address of what to call now, and how many are called."""
FINISHED, STATUS = 0, 1
"""Of its second: how many calls it has done, and what the last one returned (0, or Numba's code of an error)."""

LOOKS = 150_000
"""How often a worker looks whether something came before it gives up, about a tenth of a millisecond. Longer is no
faster on a quiet machine, and on a busy one a worker that spins has used up its turn when it is needed."""

WORD = ir.IntType(64)
RUN = ir.FunctionType(ir.IntType(32), [ir.IntType(8).as_pointer(), WORD, WORD])
"""What is called: status = run(arguments, worker, workers)."""


def new_board() -> NDArray[np.int64]:
    """An empty board, int64 [ROWS, WORDS], whose rows are cache lines."""
    words = np.zeros((ROWS + 1) * WORDS, np.int64)
    start = -(words.ctypes.data // 8) % WORDS
    return words[start : start + ROWS * WORDS].reshape(ROWS, WORDS)


def address_of(context: Any, builder: ir.IRBuilder, board_type: Any, board: ir.Value, row: Any, word: Any) -> ir.Value:
    """Of a word of the board, in code that is being compiled."""
    return element(context, builder, board_type, board, builder.add(builder.mul(row, WORD(WORDS)), word))


def address_of_arguments(context: Any, builder: ir.IRBuilder, board_type: Any, board: ir.Value) -> ir.Value:
    return builder.bitcast(address_of(context, builder, board_type, board, WORD(CALL), WORD(0)), cgutils.voidptr_t)


@intrinsic
def _read(typing_context: Any, board: Any, row: Any, word: Any) -> Any:
    """A word; what its writer wrote before it can be seen."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(address_of(context, builder, signature.args[0], *arguments), "acquire", 8)

    return types.int64(board, types.int64, types.int64), emit


@intrinsic
def _publish(typing_context: Any, board: Any, row: Any, word: Any, value: Any) -> Any:
    """Write a word; who reads it sees all that was written before, past the caches as well, hence the fence."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence("seq_cst")
        place = address_of(context, builder, signature.args[0], *arguments[:3])
        builder.store_atomic(arguments[3], place, "release", 8)
        return context.get_dummy_value()

    return types.void(board, types.int64, types.int64, types.int64), emit


@intrinsic
def _compiler_barrier(typing_context: Any) -> Any:
    """Let the compiler keep the loop around it as it is."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.asm(ir.FunctionType(ir.VoidType(), []), "", "~{memory}", [], True)
        return context.get_dummy_value()

    return types.void(), emit


@intrinsic
def _run(typing_context: Any, board: Any, kernel: Any, worker: Any, workers: Any) -> Any:
    """Call ``RUN`` at the address ``kernel`` with the arguments on the board; the status it returns."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        board, kernel, worker, workers = arguments
        own = address_of_arguments(context, builder, signature.args[0], board)
        status = builder.call(builder.inttoptr(kernel, RUN.as_pointer()), [own, worker, workers])
        return builder.sext(status, WORD)

    return types.int64(board, types.int64, types.int64, types.int64), emit


@part
def _all_finished(board: Array, workers: int, looks: int) -> bool:
    for worker in range(1, workers):
        looked = 0
        while _read(board, 2 * worker + 1, FINISHED) != board[2 * worker, CALLED]:
            if looked == looks:
                return False
            looked += 1
            _compiler_barrier()
    return True


def post(board: Array, workers: int, kernel: int) -> Any:
    """Call ``RUN`` at the address ``kernel`` for every worker, number 0 here; whether all have finished. Compiled as
    part of a kernel."""
    for worker in range(1, workers):
        board[2 * worker, KERNEL] = kernel
        board[2 * worker, WORKERS] = workers
        _publish(board, 2 * worker, CALLED, board[2 * worker, CALLED] + 1)
    board[1, STATUS] = _run(board, kernel, 0, workers)
    return _all_finished(board, workers, LOOKS)


@compiled
def all_finished(board: Array, workers: int, looks: int) -> Any:
    """Whether the helpers among so many workers have done all they were called for; looks so often for each."""
    return _all_finished(board, workers, looks)


@compiled
def serve(board: Array, worker: int, calls: int, looks: int) -> Any:
    """Run what the worker is called for until it has looked ``looks`` times in a row in vain. ``calls`` is how many it
    has done before; returns how many it has done then."""
    looked = 0
    while looked < looks:
        if _read(board, 2 * worker, CALLED) == calls:
            looked += 1
            _compiler_barrier()
            continue
        calls += 1
        board[2 * worker + 1, STATUS] = _run(board, board[2 * worker, KERNEL], worker, board[2 * worker, WORKERS])
        _publish(board, 2 * worker + 1, FINISHED, calls)
        looked = 0
    return calls
