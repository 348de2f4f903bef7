"""How a call of a kernel reaches all workers without Python: it is written on a board in memory, and rung for.

Python's interpreter runs one thread at a time. If every worker had to go through it to learn its arguments, workers
would start one after the other, and the more of them the later. Here the caller's arguments are laid out once, by
compiled code; helpers watch the board in compiled code and call the kernel from there.

A board is int64 [ROWS, WORDS], a cache line a row. Worker w has rows 2 w and 2 w + 1: one that the caller writes, one
that the worker writes. The rows from ``CALL`` on hold the kernel's arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, compiler, types
from numba.core.targetconfig import ConfigStack
from numba.extending import intrinsic
from numpy.typing import NDArray

from .compiled import Array, compiled, part

WORDS = 8
MOST_WORKERS = 256
CALL = 2 * MOST_WORKERS
CALL_ROWS = 128
ROWS = CALL + CALL_ROWS

CALLED, KERNEL, CREW = 0, 1, 2
"""Of a worker's first row: how often it was called, the address of what to call now, and by how many workers."""
FINISHED, STATUS = 0, 1
"""Of its second row: how many calls it has done, and what the last one returned (0, or Numba's code of an error)."""

LOOKS = 1_000_000
"""How often a worker looks whether something came before it falls asleep, about a millisecond. To wake it takes a tenth
to half of one: a pass has kernels that are shorter, and pauses between them."""

_WORD = ir.IntType(64)
_RUN = ir.FunctionType(ir.IntType(32), [ir.IntType(8).as_pointer(), _WORD, _WORD])
"""Status = run(arguments, worker, workers)."""


def new_board() -> NDArray[np.int64]:
    words = np.zeros((ROWS + 1) * WORDS, np.int64)
    start = -(words.ctypes.data // 8) % WORDS
    return words[start : start + ROWS * WORDS].reshape(ROWS, WORDS)


def _place(context: Any, builder: ir.IRBuilder, board_type: Any, board: ir.Value, row: Any, word: Any) -> ir.Value:
    data = context.make_array(board_type)(context, builder, board).data
    return builder.gep(data, [builder.add(builder.mul(row, _WORD(WORDS)), word)])


def _arguments(context: Any, builder: ir.IRBuilder, board_type: Any, board: ir.Value) -> ir.Value:
    return builder.bitcast(_place(context, builder, board_type, board, _WORD(CALL), _WORD(0)), cgutils.voidptr_t)


@intrinsic
def _look(typing_context: Any, board: Any, row: Any, word: Any) -> Any:
    """A word; what was written before it can be seen."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(_place(context, builder, signature.args[0], *arguments), "acquire", 8)

    return types.int64(board, types.int64, types.int64), emit


@intrinsic
def _ring(typing_context: Any, board: Any, row: Any, word: Any, count: Any) -> Any:
    """Write a word; who sees it sees what was written before."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = _place(context, builder, signature.args[0], *arguments[:3])
        builder.store_atomic(arguments[3], place, "release", 8)
        return context.get_dummy_value()

    return types.void(board, types.int64, types.int64, types.int64), emit


@intrinsic
def _pause(typing_context: Any) -> Any:
    """Let the compiler keep the loop around it."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.asm(ir.FunctionType(ir.VoidType(), []), "", "~{memory}", [], True)
        return context.get_dummy_value()

    return types.void(), emit


@intrinsic
def _run(typing_context: Any, board: Any, kernel: Any, worker: Any, workers: Any) -> Any:
    """Call the kernel at this address with the arguments on the board; the status it returns."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        board, kernel, worker, workers = arguments
        own = _arguments(context, builder, signature.args[0], board)
        status = builder.call(builder.inttoptr(kernel, _RUN.as_pointer()), [own, worker, workers])
        return builder.sext(status, _WORD)

    return types.int64(board, types.int64, types.int64, types.int64), emit


def _borrowed(context: Any, builder: ir.IRBuilder, kind: Any, value: ir.Value) -> ir.Value:
    """The same value with arrays that own nothing: nobody counts references to them, their caller keeps them."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        kinds: Any = kind
        items = zip(kinds.types, cgutils.unpack_tuple(builder, value), strict=True)
        return context.make_tuple(builder, kind, [_borrowed(context, builder, *item) for item in items])
    if context.data_model_manager[kind].contains_nrt_meminfo():
        raise TypeError(f"kernels take numbers, arrays and tuples of them, not {kind}")
    return value


def _runner(context: Any, module: ir.Module, kernel: Callable[..., None], kinds: Any, layout: ir.Type) -> ir.Function:
    """``_RUN`` of this kernel; both are compiled here, once, as part of the function that is being compiled."""
    signature = types.void(types.int64, types.int64, *kinds.types)
    flags = ConfigStack().top().copy()
    flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
    result = compiler.compile_internal(
        context.typing_context, context, context.active_code_library, kernel, signature.args, types.void, flags, {}
    )
    runner = ir.Function(module, _RUN, result.fndesc.mangled_name + ".run")
    runner.linkage = "internal"
    builder = ir.IRBuilder(runner.append_basic_block())
    own, worker, workers = runner.args
    values = cgutils.unpack_tuple(builder, builder.load(builder.bitcast(own, layout.as_pointer()), align=8))
    call = context.call_internal_no_propagate
    status, _ = call(builder, result.fndesc, signature, [worker, workers, *values])
    builder.ret(status.code)
    return runner


@part
def _all_finished(board: Array, workers: int, looks: int) -> bool:
    for worker in range(1, workers):
        looked = 0
        while _look(board, 2 * worker + 1, FINISHED) != board[2 * worker, CALLED]:
            if looked == looks:
                return False
            looked += 1
            _pause()
    return True


def _post(board: Array, workers: int, kernel: int) -> Any:
    """Call the kernel at this address for every worker; whether all have finished."""
    for worker in range(1, workers):
        board[2 * worker, KERNEL] = kernel
        board[2 * worker, CREW] = workers
        _ring(board, 2 * worker, CALLED, board[2 * worker, CALLED] + 1)
    board[1, STATUS] = _run(board, kernel, 0, workers)
    return _all_finished(board, workers, LOOKS)


@intrinsic
def _call_all(typing_context: Any, kernel: Any, board: Any, workers: Any, arguments: Any) -> Any:
    """``kernel(worker, workers, *arguments)`` for every worker, the caller being number 0; whether all are done."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        _, board_type, _, kinds = signature.args
        _, board, workers, value = values
        layout = context.get_value_type(kinds)
        if context.get_abi_sizeof(layout) > 8 * WORDS * CALL_ROWS:
            raise TypeError(f"the arguments of {kernel.typing_key.__name__} do not fit on the board")
        own = builder.bitcast(_arguments(context, builder, board_type, board), layout.as_pointer())
        builder.store(_borrowed(context, builder, kinds, value), own, align=8)
        runner = _runner(context, builder.module, kernel.typing_key, kinds, layout)
        post = types.boolean(board_type, types.int64, types.int64)
        return context.compile_internal(builder, _post, post, [board, workers, builder.ptrtoint(runner, _WORD)])

    return types.boolean(kernel, board, types.int64, arguments), emit


call_all: Any = _call_all  # typed as compiled code calls it


@compiled
def all_finished(board: Array, workers: int, looks: int) -> Any:
    """Look so often for every helper whether it has finished its call."""
    return _all_finished(board, workers, looks)


@compiled
def serve(board: Array, worker: int, calls: int, looks: int) -> Any:
    """A helper's life: run what it is called for, until it has looked so often in vain; how many calls it has heard
    by then. ``calls``: before."""
    looked = 0
    while looked < looks:
        if _look(board, 2 * worker, CALLED) == calls:
            looked += 1
            _pause()
            continue
        calls += 1
        board[2 * worker + 1, STATUS] = _run(board, board[2 * worker, KERNEL], worker, board[2 * worker, CREW])
        _ring(board, 2 * worker + 1, FINISHED, calls)
        looked = 0
    return calls
