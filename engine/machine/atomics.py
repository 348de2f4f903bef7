"""Counters that all threads see at once."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from .intrinsics import element_pointer, intrinsic, is_flat


def _raise(builder: ir.IRBuilder, pointer: ir.Value, ordering: str) -> ir.Value:
    return builder.atomic_rmw("add", pointer, ir.IntType(64)(1), ordering)


@intrinsic
def fetch_add(typing_context: Any, counter: Any) -> Any:
    """counter[0], raised by one at once for all threads: deals out work."""
    if not is_flat(counter, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], arguments[0], ir.IntType(64)(0))
        return _raise(builder, pointer, "monotonic")

    return types.int64(counter), emit


@intrinsic
def fetch_add_at(typing_context: Any, counters: Any, place: Any) -> Any:
    """counters[place] before it is raised; who reads the new number sees all that was written before, and this thread
    all that was written by those who raised it."""
    if not is_flat(counters, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _raise(builder, element_pointer(context, builder, signature.args[0], *arguments), "acq_rel")

    return types.int64(counters, types.int64), emit


@intrinsic
def load_acquire(typing_context: Any, counters: Any, place: Any) -> Any:
    """counters[place], as the last thread left it; what was written before that can be seen."""
    if not is_flat(counters, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(element_pointer(context, builder, signature.args[0], *arguments), "acquire", 8)

    return types.int64(counters, types.int64), emit
