"""Sixteen float32 at a time inside Numba: two types (``lanes`` and ``flags``) and the few operations the kernels need.
Numba has no vector types, and LLVM does not vectorise the blending loops by itself. Each operation here is one
``@intrinsic`` that emits generic LLVM vector code, which LLVM turns into what the processor has: AVX-512, AVX2, SSE or
NEON. ``+ - * /`` work on ``lanes``. ``fma`` is fused where the processor can, in the same way wherever it is used."""

from __future__ import annotations

import operator
from collections.abc import Callable
from inspect import Parameter, Signature
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

# Common parts of functions that write LLVM code themselves, and an atomic counter.

intrinsic: Any = extending.intrinsic
"""Untyped, as an intrinsic is called without the typing context in its signature, which no type checker can know."""


def element_pointer(
    context: Any, builder: ir.IRBuilder, array_type: types.Array, array: ir.Value, index: ir.Value
) -> ir.Value:
    """Emit a pointer to element ``index`` of a contiguous ``array``. The index is not checked."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def is_flat(array: types.Type, dtype: types.Type) -> bool:
    """Whether the array is one-dimensional, contiguous and of this dtype."""
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C" and array.dtype == dtype


@intrinsic
def fetch_add(typing_context: Any, counter: Any) -> Any:
    """Increase counter[0] by one atomically, and return its old value, so that threads can share out work."""
    if not is_flat(counter, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element_pointer(context, builder, signature.args[0], arguments[0], ir.IntType(64)(0))
        return builder.atomic_rmw("add", pointer, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), emit


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
    """Emit a vector with one scalar in all lanes."""
    single = builder.insert_element(ir.Constant(LANES_IR, ir.Undefined), scalar, INT(0))
    return builder.shuffle_vector(single, ir.Constant(LANES_IR, ir.Undefined), ir.Constant(INTS_IR, [0] * WIDTH))


def constant(value: float) -> ir.Constant:
    return ir.Constant(LANES_IR, [value] * WIDTH)


def call(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Value]) -> ir.Value:
    """Emit a call of LLVM's intrinsic function ``name`` with these ``arguments``, which gives the type ``result``."""
    signature = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, name), arguments)


def _intrinsic(define: Any, name: str, count: int) -> Any:
    """Define a Numba intrinsic with ``count`` arguments, whose number Numba takes from the signature."""
    parameters = [Parameter(f"argument{number}", Parameter.POSITIONAL_OR_KEYWORD) for number in range(1 + count)]
    define.__name__, define.__signature__ = name, Signature(parameters)
    return intrinsic(define)


def _on_floats(
    name: str, result: types.Type, given: tuple[types.Type, ...], emit: Callable[..., ir.Value | None]
) -> Any:
    """Define an operation on array[index] of a flat contiguous float32 array; the index is not checked. ``emit`` takes
    the builder, a pointer to that element, and the arguments of the types ``given``."""

    def define(typing_context: Any, array: Any, index: Any, *more: Any) -> Any:
        if not is_flat(array, types.float32) or more != given:
            return None

        def emit_at(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer = element_pointer(context, builder, signature.args[0], *arguments[:2])
            emitted = emit(builder, pointer, *arguments[2:])
            return context.get_dummy_value() if result is types.void else emitted

        return result(array, types.int64, *given), emit_at

    return _intrinsic(define, name, 2 + len(given))


def _sixteen(builder: ir.IRBuilder, pointer: ir.Value) -> ir.Value:
    return builder.bitcast(pointer, LANES_IR.as_pointer())


def _pairs(builder: ir.IRBuilder, pointer: ir.Value) -> ir.Value:
    two = ir.VectorType(FLOAT, 2)
    pair = builder.load(builder.bitcast(pointer, two.as_pointer()), align=4)
    indices = ir.Constant(INTS_IR, [lane % 2 for lane in range(WIDTH)])
    return builder.shuffle_vector(pair, ir.Constant(two, ir.Undefined), indices)


def _past_the_cache(builder: ir.IRBuilder, pointer: ir.Value, values: ir.Value) -> None:
    written = builder.store(values, _sixteen(builder, pointer), align=4 * WIDTH)
    written.set_metadata("nontemporal", builder.module.add_metadata([INT(1)]))


load = _on_floats("load", lanes, (), lambda builder, at: builder.load(_sixteen(builder, at), align=4))
"""load(array, index): array[index : index + 16], any alignment."""
store = _on_floats(
    "store", types.void, (lanes,), lambda builder, at, values: builder.store(values, _sixteen(builder, at), align=4)
)
"""store(array, index, values): array[index : index + 16] = values, any alignment."""
masked_load = _on_floats(
    "masked_load", lanes, (flags,),
    lambda builder, at, wanted: call(
        builder, "llvm.masked.load.v16f32.p0", LANES_IR, [_sixteen(builder, at), INT(4), wanted, constant(0.0)]
    ),
)  # fmt: skip
"""masked_load(array, index, wanted): like ``load`` where wanted, 0 elsewhere; memory outside is not touched."""
masked_store = _on_floats(
    "masked_store", types.void, (lanes, flags),
    lambda builder, at, values, wanted: call(
        builder, "llvm.masked.store.v16f32.p0", ir.VoidType(), [values, _sixteen(builder, at), INT(4), wanted]
    ),
)  # fmt: skip
"""masked_store(array, index, values, wanted): like ``store`` where wanted; memory outside is not touched."""
load_pairs = _on_floats("load_pairs", lanes, (), _pairs)
"""load_pairs(array, index): array[index] in even lanes, array[index + 1] in odd ones."""
broadcast_load = _on_floats("broadcast_load", lanes, (), lambda builder, at: broadcast_ir(builder, builder.load(at)))
"""broadcast_load(array, index): array[index] in all lanes."""
store_nontemporal = _on_floats("store_nontemporal", types.void, (lanes,), _past_the_cache)
"""Like ``store`` at the beginning of a cache line, but without reading the old values or caching the new ones."""


@intrinsic
def get(typing_context: Any, array: Any, index: Any) -> Any:
    """Return array[index] of a flat contiguous array. The index is not checked and must not be negative."""
    if not is_flat(array, array.dtype):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(element_pointer(context, builder, signature.args[0], *arguments))

    return array.dtype(array, types.int64), emit


@intrinsic
def put(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Set array[index] of a flat contiguous array to a value of its type. The index is not checked."""
    if not is_flat(array, array.dtype):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], element_pointer(context, builder, signature.args[0], *arguments[:2]))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), emit


@intrinsic
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Fetch the cache line of array[index] into the cache, to be read a little later. Any index is harmless."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.bitcast(element_pointer(context, builder, signature.args[0], *arguments), BYTES_IR)
        call(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, INT(0), INT(3), INT(1)])  # read, keep cached, data
        return context.get_dummy_value()

    return types.void(array, types.int64), emit


def of_values(name: str, result: types.Type, given: tuple[types.Type, ...], emit: Callable[..., Any]) -> Any:
    """Define an operation on values of the types ``given``. ``emit`` takes the builder and the values and returns the
    result, for a tuple as a list."""

    def define(typing_context: Any, *values: Any) -> Any:
        def emit_them(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            emitted = emit(builder, *arguments)
            return context.make_tuple(builder, result, emitted) if isinstance(result, types.UniTuple) else emitted

        return result(*given), emit_them

    return _intrinsic(define, name, len(given))


def _fused(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
    return call(builder, "llvm.fmuladd.v16f32", LANES_IR, [a, b, c])


_two, _three = (lanes, lanes), (lanes, lanes, lanes)
broadcast = of_values("broadcast", lanes, (types.float32,), broadcast_ir)
"""broadcast(scalar): a scalar in all lanes."""
lane_numbers = of_values(
    "lane_numbers", lanes, (), lambda builder: ir.Constant(LANES_IR, [float(lane) for lane in range(WIDTH)])
)
"""lane_numbers(): 0, 1, ... 15."""
fma = of_values("fma", lanes, _three, _fused)
"""fma(a, b, c): a * b + c."""
fnmadd = of_values("fnmadd", lanes, _three, lambda builder, a, b, c: _fused(builder, builder.fneg(a), b, c))
"""fnmadd(a, b, c): c - a * b, fused if the processor supports it."""
minimum = of_values("minimum", lanes, _two, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))
"""minimum(a, b): b where it is less than a, else a."""
maximum = of_values("maximum", lanes, _two, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))
"""maximum(a, b): b where it is greater than a, else a."""
square_root = of_values(
    "square_root", lanes, (lanes,), lambda builder, a: call(builder, "llvm.sqrt.v16f32", LANES_IR, [a])
)
"""square_root(a), correctly rounded."""
select = of_values("select", lanes, (flags, lanes, lanes), ir.IRBuilder.select)
"""select(condition, a, b): a where the flag is set, else b."""
movemask = of_values(
    "movemask", types.int64, (flags,), lambda builder, own: builder.zext(builder.bitcast(own, MASK_IR), ir.IntType(64))
)
"""movemask(condition): the flags as an integer, lane 0 lowest."""
trailing_zeros = of_values(
    "trailing_zeros", types.int64, (types.int64,),
    lambda builder, bits: call(builder, "llvm.cttz.i64", ir.IntType(64), [bits, ir.Constant(ir.IntType(1), 0)]),
)  # fmt: skip
"""trailing_zeros(bits): the index of the lowest set bit, 64 if there is none."""


def _register(function: Any, given: types.Type, result: types.Type, emit: Callable[..., ir.Value]) -> None:
    """Define ``function``, an operator, for two values of the type ``given``."""

    @type_callable(function)
    def type_of(context: Any) -> Any:
        return lambda a, b: result if a is given and b is given else None

    @lower_builtin(function, given, given)
    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return emit(builder, *arguments)


_register(operator.add, lanes, lanes, ir.IRBuilder.fadd)
_register(operator.sub, lanes, lanes, ir.IRBuilder.fsub)
_register(operator.mul, lanes, lanes, ir.IRBuilder.fmul)
_register(operator.truediv, lanes, lanes, ir.IRBuilder.fdiv)
_register(operator.gt, lanes, flags, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_register(operator.ge, lanes, flags, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_register(operator.le, lanes, flags, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_register(operator.lt, lanes, flags, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_register(operator.and_, flags, flags, ir.IRBuilder.and_)


# Powers of two of sixteen float32 at a time.

# 2^f on [-1/2, 1/2], Chebyshev interpolation; relative error 1e-7 in float32
_COEFFICIENTS = (
    0.00015461444854736328,
    0.0013400427997112274,
    0.009618056938052177,
    0.05550327152013779,
    0.24022650718688965,
    0.6931471824645996,
    1.0,
)
_ROUNDING = 12582912.0  # 1.5 * 2^23: adding it leaves the nearest integer in the low bits of the mantissa
_LOWEST = -64.0
Values = list[ir.Value]


def _powers(builder: ir.IRBuilder, exponents: Values) -> Values:
    """Emit 2 to the power of each exponent. Each step is done for all exponents before the next step."""
    lowest, rounding = constant(_LOWEST), constant(_ROUNDING)
    exponents = [builder.select(builder.fcmp_ordered(">", a, lowest), a, lowest) for a in exponents]
    shifted = [builder.fadd(a, rounding) for a in exponents]
    wholes = [builder.fsub(value, rounding) for value in shifted]
    fractions = [builder.fsub(a, whole) for a, whole in zip(exponents, wholes, strict=True)]
    values: Values = [constant(_COEFFICIENTS[0])] * len(fractions)
    for coefficient in map(constant, _COEFFICIENTS[1:]):
        values = [
            call(builder, "llvm.fmuladd.v16f32", LANES_IR, [value, f, coefficient])
            for value, f in zip(values, fractions, strict=True)
        ]
    # The integer part is in the low bits of ``shifted``. It is added to the exponent's bits.
    bits = [builder.shl(builder.bitcast(value, INTS_IR), ir.Constant(INTS_IR, [23] * WIDTH)) for value in shifted]
    sums = [builder.add(builder.bitcast(value, INTS_IR), own) for value, own in zip(values, bits, strict=True)]
    return [builder.bitcast(own, LANES_IR) for own in sums]


exp2 = of_values("exp2", lanes, (lanes,), lambda builder, a: _powers(builder, [a])[0])
"""exp2(a): 2^a for a <= 127; values below -64 are treated as -64, so that no product with it is a (slow) subnormal."""
exp2_x4 = of_values(
    "exp2_x4", types.UniTuple(lanes, 4), (lanes,) * 4, lambda builder, *four: _powers(builder, list(four))
)
"""exp2_x4(a, b, c, d): ``exp2`` of each, interleaved, as a single one is a chain of ten dependent operations."""
