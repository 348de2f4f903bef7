"""A counter that all threads see at once."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from .emitting import element, intrinsic, is_flat


@intrinsic
def take_next(typing_context: Any, counter: Any) -> Any:
    """counter[0], raised by one at once for all threads: deals out work."""
    if not is_flat(counter, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], arguments[0], ir.IntType(64)(0))
        return builder.atomic_rmw("add", pointer, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), emit
