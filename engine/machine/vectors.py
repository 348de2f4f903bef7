"""Sixteen float32 at a time inside Numba: two types (``lanes`` and ``flags``) and the few operations the kernels need.

Numba has no vector types, and LLVM does not vectorise the blending loops by itself. Each operation here is one
``@intrinsic`` that emits generic LLVM vector code, which LLVM turns into what the processor has: AVX-512, AVX2, SSE or
NEON. ``+ - * /`` work on ``lanes``. ``fma`` is fused where the processor can, in the same way wherever it is used.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from .intrinsics import element_pointer, intrinsic, is_flat

WIDTH = 16

FLOAT = ir.FloatType()
INT = ir.IntType(32)
MASK_IR = ir.IntType(WIDTH)
LANES_IR = ir.VectorType(FLOAT, WIDTH)
INTS_IR = ir.VectorType(INT, WIDTH)
BYTES_IR = ir.IntType(8).as_pointer()
FLAGS_IR = ir.VectorType(ir.IntType(1), WIDTH)


class _Vector(types.Type):
    def __init__(self, name: str) -> None:
        super().__init__(name=f"plgs_{name}")


lanes = _Vector("lanes")
"""Sixteen float32."""
flags = _Vector("flags")
"""Sixteen booleans."""


class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: _Vector) -> None:
        super().__init__(manager, numba_type, LANES_IR if numba_type is lanes else FLAGS_IR)


register_model(_Vector)(_VectorModel)


def broadcast_ir(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    """One scalar in all lanes."""
    single = builder.insert_element(ir.Constant(LANES_IR, ir.Undefined), scalar, INT(0))
    return builder.shuffle_vector(single, ir.Constant(LANES_IR, ir.Undefined), ir.Constant(INTS_IR, [0] * WIDTH))


def constant(value: float) -> ir.Constant:
    return ir.Constant(LANES_IR, [value] * WIDTH)


def call(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Value]) -> ir.Value:
    """Call one of LLVM's own functions."""
    signature = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, name), arguments)


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16] of a flat contiguous float32 array; unchecked, any alignment."""
    if not is_flat(array, types.float32):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], *arguments)
        return builder.load(builder.bitcast(pointer, LANES_IR.as_pointer()), align=4)

    return lanes(array, types.int64), emit


@intrinsic
def store(typing_context: Any, array: Any, index: Any, values: Any) -> Any:
    """array[index : index + 16] = values; unchecked, any alignment."""
    if not is_flat(array, types.float32) or values is not lanes:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], builder.bitcast(pointer, LANES_IR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), emit


@intrinsic
def masked_load(typing_context: Any, array: Any, index: Any, wanted: Any) -> Any:
    """Like ``load`` where wanted, 0 elsewhere; memory outside is not touched."""
    if not is_flat(array, types.float32) or wanted is not flags:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], *arguments[:2])
        pointer = builder.bitcast(pointer, LANES_IR.as_pointer())
        values = [pointer, INT(4), arguments[2], constant(0.0)]
        return call(builder, "llvm.masked.load.v16f32.p0", LANES_IR, values)

    return lanes(array, types.int64, flags), emit


@intrinsic
def masked_store(typing_context: Any, array: Any, index: Any, values: Any, wanted: Any) -> Any:
    """Like ``store`` where wanted; memory outside is not touched."""
    if not is_flat(array, types.float32) or values is not lanes or wanted is not flags:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], *arguments[:2])
        pointer = builder.bitcast(pointer, LANES_IR.as_pointer())
        values = [arguments[2], pointer, INT(4), arguments[3]]
        call(builder, "llvm.masked.store.v16f32.p0", ir.VoidType(), values)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes, flags), emit


@intrinsic
def load_pairs(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat contiguous float32 array in even lanes, array[index + 1] in odd ones; unchecked."""
    if not is_flat(array, types.float32):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        two = ir.VectorType(FLOAT, 2)
        pointer = element_pointer(context, builder, signature.args[0], *arguments)
        pair = builder.load(builder.bitcast(pointer, two.as_pointer()), align=4)
        places = ir.Constant(INTS_IR, [lane % 2 for lane in range(WIDTH)])
        return builder.shuffle_vector(pair, ir.Constant(two, ir.Undefined), places)

    return lanes(array, types.int64), emit


@intrinsic
def get(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat contiguous array; unchecked, and no negative index."""
    if not is_flat(array, array.dtype):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(element_pointer(context, builder, signature.args[0], *arguments))

    return array.dtype(array, types.int64), emit


@intrinsic
def put(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] = value of a flat contiguous array, the value already of its type; unchecked."""
    if not is_flat(array, array.dtype):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], element_pointer(context, builder, signature.args[0], *arguments[:2]))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), emit


@intrinsic
def broadcast_load(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat contiguous float32 array in all lanes; unchecked."""
    if not is_flat(array, types.float32):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return broadcast_ir(builder, builder.load(element_pointer(context, builder, signature.args[0], *arguments)))

    return lanes(array, types.int64), emit


@intrinsic
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Fetch the cache line of array[index] into the cache, to be read a little later; any index is harmless."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.bitcast(element_pointer(context, builder, signature.args[0], *arguments), BYTES_IR)
        call(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), emit


@intrinsic
def store_nontemporal(typing_context: Any, array: Any, index: Any, values: Any) -> Any:
    """Like ``store`` at the beginning of a cache line, but without reading the old values or caching the new ones."""
    if not is_flat(array, types.float32) or values is not lanes:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], *arguments[:2])
        written = builder.store(arguments[2], builder.bitcast(pointer, LANES_IR.as_pointer()), align=4 * WIDTH)
        written.set_metadata("nontemporal", builder.module.add_metadata([INT(1)]))
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), emit


@intrinsic
def broadcast(typing_context: Any, scalar: Any) -> Any:
    """A scalar in all lanes."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return broadcast_ir(builder, arguments[0])

    return lanes(types.float32), emit


@intrinsic
def lane_numbers(typing_context: Any) -> Any:
    """0, 1, ... 15."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(LANES_IR, [float(lane) for lane in range(WIDTH)])

    return lanes(), emit


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return call(builder, "llvm.fmuladd.v16f32", LANES_IR, list(arguments))

    return lanes(lanes, lanes, lanes), emit


@intrinsic
def fnmadd(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """c - a * b, fused if the processor supports it."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, c = arguments
        return call(builder, "llvm.fmuladd.v16f32", LANES_IR, [builder.fneg(a), b, c])

    return lanes(lanes, lanes, lanes), emit


@intrinsic
def minimum(typing_context: Any, a: Any, b: Any) -> Any:
    """b where it is less than a, else a."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b = arguments
        return builder.select(builder.fcmp_ordered("<", b, a), b, a)

    return lanes(lanes, lanes), emit


@intrinsic
def maximum(typing_context: Any, a: Any, b: Any) -> Any:
    """b where it is greater than a, else a."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b = arguments
        return builder.select(builder.fcmp_ordered(">", b, a), b, a)

    return lanes(lanes, lanes), emit


@intrinsic
def select(typing_context: Any, condition: Any, a: Any, b: Any) -> Any:
    """a where the flag is set, else b."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return lanes(flags, lanes, lanes), emit


@intrinsic
def movemask(typing_context: Any, condition: Any) -> Any:
    """The flags as an integer, lane 0 lowest."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.bitcast(arguments[0], MASK_IR), ir.IntType(64))

    return types.int64(flags), emit


@intrinsic
def trailing_zeros(typing_context: Any, bits: Any) -> Any:
    """The place of the lowest set bit, 64 if there is none."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return call(builder, "llvm.cttz.i64", ir.IntType(64), [arguments[0], ir.Constant(ir.IntType(1), 0)])

    return types.int64(types.int64), emit


def _register_arithmetic() -> None:
    def register(function: Any, emit: Any) -> None:
        @type_callable(function)
        def type_of(context: Any) -> Any:
            return lambda a, b: lanes if a is lanes and b is lanes else None

        @lower_builtin(function, lanes, lanes)
        def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return emit(builder, *arguments)

    register(operator.add, ir.IRBuilder.fadd)
    register(operator.sub, ir.IRBuilder.fsub)
    register(operator.mul, ir.IRBuilder.fmul)
    register(operator.truediv, ir.IRBuilder.fdiv)


def _register_comparisons() -> None:
    def register(function: Any, symbol: str) -> None:
        @type_callable(function)
        def type_of(context: Any) -> Any:
            return lambda a, b: flags if a is lanes and b is lanes else None

        @lower_builtin(function, lanes, lanes)
        def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.fcmp_ordered(symbol, *arguments)

    register(operator.gt, ">")
    register(operator.ge, ">=")
    register(operator.le, "<=")
    register(operator.lt, "<")

    @type_callable(operator.and_)
    def type_of(context: Any) -> Any:
        return lambda a, b: flags if a is flags and b is flags else None

    @lower_builtin(operator.and_, flags, flags)
    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(*arguments)


_register_arithmetic()
_register_comparisons()
