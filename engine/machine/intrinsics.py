"""What functions that write LLVM code themselves have in common."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending, types

intrinsic: Any = extending.intrinsic
"""Called without the typing context that it is declared with, which no type checker can know."""


def element_pointer(
    context: Any, builder: ir.IRBuilder, array_type: types.Array, array: ir.Value, index: ir.Value
) -> ir.Value:
    """Pointer to the element at this place in the memory of a contiguous array, unchecked."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def is_flat(array: types.Type, dtype: types.Type) -> bool:
    """Whether it is one-dimensional, contiguous and of this dtype."""
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C" and array.dtype == dtype
