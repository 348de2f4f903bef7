"""Sixteen float32 at a time inside Numba: two types (``Lanes`` and ``Flags``) and the few operations the
kernels need.

Numba has no vector types, and LLVM does not vectorise the blending loops by itself. Each operation here is
one ``@intrinsic`` that emits generic LLVM vector code: LLVM turns it into AVX-512, AVX2, SSE or NEON,
whatever the machine has. ``+ - *`` work on ``Lanes``; ``fma`` is fused where the machine can, in the same way
wherever it is used.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from .compiled import machine_target

intrinsic: Any = extending.intrinsic
"""Called without the typing context that it is declared with, which no type checker can know."""

WIDTH = 16

FLOAT = ir.FloatType()
INT = ir.IntType(32)
WORD = ir.IntType(WIDTH)
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


def splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    """One scalar in all lanes."""
    single = builder.insert_element(ir.Constant(LANES_IR, ir.Undefined), scalar, INT(0))
    return builder.shuffle_vector(
        single, ir.Constant(LANES_IR, ir.Undefined), ir.Constant(INTS_IR, [0] * WIDTH)
    )


def constant(value: float) -> ir.Constant:
    return ir.Constant(LANES_IR, [value] * WIDTH)


def call(builder: ir.IRBuilder, name: str, result: ir.Type, arguments: list[ir.Value]) -> ir.Value:
    """Call one of LLVM's own functions."""
    signature = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, name), arguments)


def element(
    context: Any, builder: ir.IRBuilder, array_type: types.Array, array: ir.Value, index: ir.Value
) -> ir.Value:
    """Pointer to ``array[index]`` of a one-dimensional contiguous array, unchecked."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _is_flat(array: types.Type, dtype: types.Type) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C" and array.dtype == dtype


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16] of a flat contiguous float32 array; unchecked, any alignment."""
    if not _is_flat(array, types.float32):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], *arguments)
        return builder.load(builder.bitcast(pointer, LANES_IR.as_pointer()), align=4)

    return lanes(array, types.int64), emit


@intrinsic
def store(typing_context: Any, array: Any, index: Any, values: Any) -> Any:
    """array[index : index + 16] = values; unchecked, any alignment."""
    if not _is_flat(array, types.float32) or values is not lanes:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], builder.bitcast(pointer, LANES_IR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), emit


@intrinsic
def load_some(typing_context: Any, array: Any, index: Any, wanted: Any) -> Any:
    """As ``load`` where wanted, 0 elsewhere; memory outside is not touched."""
    if not _is_flat(array, types.float32) or wanted is not flags:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], *arguments[:2])
        pointer = builder.bitcast(pointer, LANES_IR.as_pointer())
        values = [pointer, INT(4), arguments[2], constant(0.0)]
        return call(builder, "llvm.masked.load.v16f32.p0", LANES_IR, values)

    return lanes(array, types.int64, flags), emit


@intrinsic
def store_some(typing_context: Any, array: Any, index: Any, values: Any, wanted: Any) -> Any:
    """As ``store`` where wanted; memory outside is not touched."""
    if not _is_flat(array, types.float32) or values is not lanes or wanted is not flags:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], *arguments[:2])
        pointer = builder.bitcast(pointer, LANES_IR.as_pointer())
        values = [arguments[2], pointer, INT(4), arguments[3]]
        call(builder, "llvm.masked.store.v16f32.p0", ir.VoidType(), values)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes, flags), emit


@intrinsic
def get(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat contiguous array; unchecked, and no negative index."""
    if not _is_flat(array, array.dtype):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(element(context, builder, signature.args[0], *arguments))

    return array.dtype(array, types.int64), emit


@intrinsic
def put(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] = value of a flat contiguous array, the value already of its type; unchecked."""
    if not _is_flat(array, array.dtype):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], element(context, builder, signature.args[0], *arguments[:2]))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), emit


@intrinsic
def everywhere(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat contiguous float32 array in all lanes; unchecked."""
    if not _is_flat(array, types.float32):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return splat(builder, builder.load(element(context, builder, signature.args[0], *arguments)))

    return lanes(array, types.int64), emit


def _fetch(to_write: int) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.bitcast(element(context, builder, signature.args[0], *arguments), BYTES_IR)
        call(builder, "llvm.prefetch.p0", ir.VoidType(), [pointer, INT(to_write), INT(3), INT(1)])
        return context.get_dummy_value()

    return emit


@intrinsic
def fetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Have the cache line of array[index] brought, to be read a little later; any index is harmless."""
    return types.void(array, types.int64), _fetch(0)


@intrinsic
def fetch_to_write(typing_context: Any, array: Any, index: Any) -> Any:
    """Have the cache line of array[index] brought, to be written a little later; any index is harmless."""
    return types.void(array, types.int64), _fetch(1)


@intrinsic
def is_aligned(typing_context: Any, array: Any, index: Any) -> Any:
    """Whether array[index] begins a cache line."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = builder.ptrtoint(element(context, builder, signature.args[0], *arguments), ir.IntType(64))
        rest = builder.and_(address, ir.IntType(64)(4 * WIDTH - 1))
        return builder.icmp_unsigned("==", rest, ir.IntType(64)(0))

    return types.boolean(array, types.int64), emit


@intrinsic
def store_past_cache(typing_context: Any, array: Any, index: Any, values: Any) -> Any:
    """As ``store``, at the beginning of a cache line, without reading what was there nor keeping it in the cache."""
    if not _is_flat(array, types.float32) or values is not lanes:
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], *arguments[:2])
        written = builder.store(arguments[2], builder.bitcast(pointer, LANES_IR.as_pointer()), align=4 * WIDTH)
        written.set_metadata("nontemporal", builder.module.add_metadata([INT(1)]))
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), emit


@intrinsic
def spread(typing_context: Any, scalar: Any) -> Any:
    """A scalar in all lanes."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return splat(builder, arguments[0])

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
def less_product(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """c - a * b, fused where the machine can."""

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
def choose(typing_context: Any, condition: Any, a: Any, b: Any) -> Any:
    """a where the flag is set, else b."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return lanes(flags, lanes, lanes), emit


@intrinsic
def bits_of(typing_context: Any, condition: Any) -> Any:
    """The flags as an integer, lane 0 lowest."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.bitcast(arguments[0], WORD), ir.IntType(64))

    return types.int64(flags), emit


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """The place of the lowest bit set, 64 when there is none."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return call(builder, "llvm.cttz.i64", ir.IntType(64), [arguments[0], ir.Constant(ir.IntType(1), 0)])

    return types.int64(types.int64), emit


# 2^f on [-1/2, 1/2] and on [0, 1], Chebyshev interpolation; relative error 1e-7 in float32
_EXP2_AROUND_ZERO = (
    0.00015461444854736328,
    0.0013400427997112274,
    0.009618056938052177,
    0.05550327152013779,
    0.24022650718688965,
    0.6931471824645996,
    1.0,
)
_EXP2_UP_TO_ONE = (
    0.00021865784947294742,
    0.0012391331838443875,
    0.009684186428785324,
    0.055480629205703735,
    0.24023045599460602,
    0.6931469440460205,
    1.0,
)
_ROUNDING = 12582912.0  # 1.5 * 2^23: adding it leaves the nearest integer in the low bits of the mantissa
_LOWEST = -64.0


def has_wide_registers() -> bool:
    """AVX-512: thirty-two registers of sixteen floats, and its own steps of an exponential. Where Numba is told to
    compile for a machine without them, there are none."""
    features = machine_target()[2].split(",")
    return "+avx512f" in features and "+avx512dq" in features


WIDE = has_wide_registers()
_ALL = ir.Constant(WORD, -1)
_NEAREST_IS_FLOOR, _AS_SET = INT(1), INT(4)


def _polynomials(builder: ir.IRBuilder, places: list[ir.Value], coefficients: tuple[float, ...]) -> list[ir.Value]:
    values: list[ir.Value] = [constant(coefficients[0])] * len(places)
    for coefficient in map(constant, coefficients[1:]):
        values = [
            call(builder, "llvm.fmuladd.v16f32", LANES_IR, [value, f, coefficient])
            for value, f in zip(values, places, strict=True)
        ]
    return values


def _exp2_wide(builder: ir.IRBuilder, exponents: list[ir.Value]) -> list[ir.Value]:
    """The fraction, and the scaling by the whole part, are one instruction each."""
    rest = [constant(0.0), _ALL, _AS_SET]
    reduce, scale = "llvm.x86.avx512.mask.reduce.ps.512", "llvm.x86.avx512.mask.scalef.ps.512"
    fractions = [call(builder, reduce, LANES_IR, [a, _NEAREST_IS_FLOOR, *rest]) for a in exponents]
    values = _polynomials(builder, fractions, _EXP2_UP_TO_ONE)
    return [call(builder, scale, LANES_IR, [value, a, *rest]) for value, a in zip(values, exponents, strict=True)]


def _exp2_anywhere(builder: ir.IRBuilder, exponents: list[ir.Value]) -> list[ir.Value]:
    """With the whole part rounded off by a large number, and added to the exponent's bits."""
    shifted = [builder.fadd(a, constant(_ROUNDING)) for a in exponents]
    wholes = [builder.fsub(value, constant(_ROUNDING)) for value in shifted]
    fractions = [builder.fsub(a, whole) for a, whole in zip(exponents, wholes, strict=True)]
    values = _polynomials(builder, fractions, _EXP2_AROUND_ZERO)
    bits = [builder.shl(builder.bitcast(value, INTS_IR), ir.Constant(INTS_IR, [23] * WIDTH)) for value in shifted]
    sums = [builder.add(builder.bitcast(value, INTS_IR), own) for value, own in zip(values, bits, strict=True)]
    return [builder.bitcast(own, LANES_IR) for own in sums]


def _exp2(builder: ir.IRBuilder, exponents: list[ir.Value]) -> list[ir.Value]:
    lowest = constant(_LOWEST)
    exponents = [builder.select(builder.fcmp_ordered(">", a, lowest), a, lowest) for a in exponents]
    return (_exp2_wide if WIDE else _exp2_anywhere)(builder, exponents)


@intrinsic
def exp2(typing_context: Any, a: Any) -> Any:
    """2^a for a <= 127; what is below -64 counts as -64, so that no product with it is a (slow) subnormal."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _exp2(builder, list(arguments))[0]

    return lanes(lanes), emit


@intrinsic
def exp2_of_four(typing_context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """``exp2`` of each, side by side: one alone is a chain of ten operations that wait for one another."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.make_tuple(builder, signature.return_type, _exp2(builder, list(arguments)))

    return types.UniTuple(lanes, 4)(lanes, lanes, lanes, lanes), emit


@intrinsic
def reciprocal(typing_context: Any, a: Any) -> Any:
    """1 / a for normal numbers, to within two units in the last place.

    With AVX-512 an estimate of 14 bits and one Newton step: a division would hold up everything else for
    sixteen cycles.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a = arguments[0]
        if not WIDE:
            return builder.fdiv(constant(1.0), a)
        estimate = call(builder, "llvm.x86.avx512.rcp14.ps.512", LANES_IR, [a, constant(0.0), _ALL])
        error = call(builder, "llvm.fmuladd.v16f32", LANES_IR, [builder.fneg(a), estimate, constant(1.0)])
        return call(builder, "llvm.fmuladd.v16f32", LANES_IR, [estimate, error, estimate])

    return lanes(lanes), emit


@intrinsic
def totals(typing_context: Any, vectors: Any) -> Any:
    """Lane i of the result is the sum over the lanes of vector i of a tuple of at most sixteen; the others
    are 0.

    A tree of pairwise sums: neighbours are folded together until one vector is left, always in the same
    order.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        level = list(cgutils.unpack_tuple(builder, arguments[0]))
        level += [None] * (WIDTH - len(level))
        width = WIDTH
        while width > 1:
            half = width // 2
            level = [_fold(builder, a, b, width, half) for a, b in zip(level[::2], level[1::2], strict=True)]
            width = half
        return level[0]

    return lanes(vectors), emit


def _fold(
    builder: ir.IRBuilder, a: ir.Value | None, b: ir.Value | None, width: int, half: int
) -> ir.Value | None:
    """Vectors of groups of ``width`` partial sums each to one of groups of ``half``: a's groups, then b's."""
    if a is None:
        return None
    b = constant(0.0) if b is None else b
    groups = range(0, 2 * WIDTH, width)
    low = [group + lane for group in groups for lane in range(half)]
    high = [group + half + lane for group in groups for lane in range(half)]
    return builder.fadd(
        builder.shuffle_vector(a, b, ir.Constant(INTS_IR, low)),
        builder.shuffle_vector(a, b, ir.Constant(INTS_IR, high)),
    )


def _shuffled(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, places: list[int]) -> ir.Value:
    return builder.shuffle_vector(a, b, ir.Constant(INTS_IR, places))


@intrinsic
def interleaved(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a0 b0 c0 a1 b1 c1 ... c15 as three vectors: planes to pixels."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, c = arguments
        vectors = []
        for start in range(0, 3 * WIDTH, WIDTH):
            places = [divmod(start + lane, 3) for lane in range(WIDTH)]
            pairs = _shuffled(builder, a, b, [pixel + WIDTH * (plane == 1) for pixel, plane in places])
            mixed = [WIDTH + pixel if plane == 2 else lane for lane, (pixel, plane) in enumerate(places)]
            vectors.append(_shuffled(builder, pairs, c, mixed))
        return context.make_tuple(builder, signature.return_type, vectors)

    return types.UniTuple(lanes, 3)(lanes, lanes, lanes), emit


@intrinsic
def planes_of(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """The inverse of ``interleaved``: pixels to planes."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, c = arguments
        planes = []
        for plane in range(3):
            places = [3 * lane + plane for lane in range(WIDTH)]
            front = [place if place < 2 * WIDTH else 0 for place in places]
            both = _shuffled(builder, a, b, front)
            mixed = [WIDTH + place - 2 * WIDTH if place >= 2 * WIDTH else lane for lane, place in enumerate(places)]
            planes.append(_shuffled(builder, both, c, mixed))
        return context.make_tuple(builder, signature.return_type, planes)

    return types.UniTuple(lanes, 3)(lanes, lanes, lanes), emit


@intrinsic
def take_next(typing_context: Any, counter: Any) -> Any:
    """counter[0], raised by one at once for all threads: deals out work."""
    if not _is_flat(counter, types.int64):
        return None

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = element(context, builder, signature.args[0], arguments[0], ir.IntType(64)(0))
        return builder.atomic_rmw("add", pointer, ir.IntType(64)(1), "monotonic")

    return types.int64(counter), emit


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
