"""``shared``, the decorator of kernels that are done by several workers at once, each its share.

Such a kernel is written as ``kernel(worker, workers, *arguments)``: what this worker does of the whole, which does not
depend on how many they are. What is compiled, ``kernel(board, workers, arguments)``, writes the arguments to a board
and runs the shares of all; ``crew.share`` calls it. Arguments are numbers, arrays, and tuples of them.
"""

from __future__ import annotations

import builtins
from collections.abc import Callable
from types import FunctionType
from typing import Any

from llvmlite import ir
from numba.core import cgutils, compiler, types
from numba.core.targetconfig import ConfigStack

from .blackboard import CALL_ROWS, RUN, WORD, WORDS, address_of_arguments, post
from .compiled import Array, compiled, contracted, part
from .emitting import intrinsic

Kernel = Callable[..., Any]
"""What ``shared`` makes: a compiled function of a board, a number of workers and a tuple of arguments."""


def shared(function: Callable[..., None]) -> Any:
    """Compiled as ``compiled`` does; its shares start side by side, and make their own arrays where they need some."""
    return compiled(_entry_of(function))


def shared_contracted(function: Callable[..., None]) -> Any:
    """As ``contracted`` does."""
    return contracted(_entry_of(function))


@intrinsic
def call_all(typing_context: Any, share: Any, board: Any, workers: Any, arguments: Any) -> Any:
    """``share(worker, workers, *arguments)`` for every worker, the caller being number 0; whether all are done."""

    def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        _, board_type, _, kinds = signature.args
        _, board, workers, value = values
        layout = context.get_value_type(kinds)
        if context.get_abi_sizeof(layout) > 8 * WORDS * CALL_ROWS:
            raise TypeError(f"the arguments of {share.typing_key.__name__} do not fit on the board")
        own = builder.bitcast(address_of_arguments(context, builder, board_type, board), layout.as_pointer())
        builder.store(_borrowed(context, builder, kinds, value), own, align=8)
        run = _compile_share(context, builder.module, share.typing_key, kinds, layout)
        post_signature = types.boolean(board_type, types.int64, types.int64)
        return context.compile_internal(builder, post, post_signature, [board, workers, builder.ptrtoint(run, WORD)])

    return types.boolean(share, board, types.int64, arguments), emit


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


def _compile_share(context: Any, module: ir.Module, share: Callable[..., None], kinds: Any, layout: ir.Type) -> Any:
    """``RUN`` of this share. Both become part of the function that is being compiled, with its options: compiled by
    itself the share would go through LLVM twice."""
    signature = types.void(types.int64, types.int64, *kinds.types)
    flags = ConfigStack().top().copy()
    flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
    result = compiler.compile_internal(
        context.typing_context, context, context.active_code_library, share, signature.args, types.void, flags, {}
    )
    run = ir.Function(module, RUN, result.fndesc.mangled_name + ".run")
    run.linkage = "internal"
    builder = ir.IRBuilder(run.append_basic_block())
    own, worker, workers = run.args
    values = cgutils.unpack_tuple(builder, builder.load(builder.bitcast(own, layout.as_pointer()), align=8))
    status, _ = context.call_internal_no_propagate(builder, result.fndesc, signature, [worker, workers, *values])
    builder.ret(status.code)
    return run


share: Any = None
"""In each copy of ``_entry`` another kernel's."""


def _entry(board: Array, workers: int, arguments: Any) -> Any:
    return call_all(share, board, workers, arguments)


def _entry_of(function: Callable[..., None]) -> Callable[..., Any]:
    """``_entry`` where ``share`` is this function, under its name.

    Numba keeps what it compiled in files named after a function's file, name and line. A function inside this one would
    be one and the same for all kernels, and two processes that compile would overwrite each other's files.
    """
    own = function.__code__
    code = _entry.__code__.replace(
        co_name=own.co_name, co_qualname=own.co_qualname, co_filename=own.co_filename, co_firstlineno=own.co_firstlineno
    )
    names = {"share": part(function), "call_all": call_all, "__name__": function.__module__, "__builtins__": builtins}
    entry = FunctionType(code, names, function.__name__)
    entry.__module__, entry.__qualname__, entry.__doc__ = function.__module__, function.__qualname__, function.__doc__
    return entry
