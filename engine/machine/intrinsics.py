"""Common parts of functions that write LLVM code themselves, and an atomic counter."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending, types

intrinsic: Any = extending.intrinsic
"""It is called without the typing context that it is declared with, which no type checker can know."""


def element_pointer(
    context: Any, builder: ir.IRBuilder, array_type: types.Array, array: ir.Value, index: ir.Value
) -> ir.Value:
    """A pointer to the element at this place in the memory of a contiguous array, unchecked."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def is_flat(array: types.Type, dtype: types.Type) -> bool:
    """Whether the array is one-dimensional, contiguous and of this dtype."""
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C" and array.dtype == dtype


@intrinsic
def fetch_add(typing_context: Any, counter: Any) -> Any:
    """Increase counter[0] by one atomically, and return its old value. It distributes work among threads."""
    if not is_flat(counter, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], arguments[0], ir.IntType(64)(0))
        return builder.atomic_rmw("add", pointer, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), emit
