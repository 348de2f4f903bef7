"""Powers of two and reciprocals of sixteen float32 at a time."""

from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils

from .intrinsics import intrinsic
from .vectors import FLOAT, HAS_AVX512, INT, INTS_IR, LANES_IR, MASK_IR, WIDTH, call, constant, lanes

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
_COEFFICIENTS = _EXP2_UP_TO_ONE if HAS_AVX512 else _EXP2_AROUND_ZERO
_ALL = ir.Constant(MASK_IR, -1)
_NEAREST_IS_FLOOR, _AS_SET = INT(1), INT(4)

if HAS_AVX512:
    binding.initialize_native_asmparser()  # of ``_four_powers``

Values = list[ir.Value]


def _no_less_than_lowest(builder: ir.IRBuilder, exponents: Values) -> Values:
    lowest = constant(_LOWEST)
    return [builder.select(builder.fcmp_ordered(">", a, lowest), a, lowest) for a in exponents]


def _begin(builder: ir.IRBuilder, exponents: Values) -> tuple[Values, Values]:
    """The whole parts of the exponents, as ``_end`` takes them, and their fractions."""
    exponents = _no_less_than_lowest(builder, exponents)
    if HAS_AVX512:  # one instruction
        rest = [constant(0.0), _ALL, _AS_SET]
        reduce = "llvm.x86.avx512.mask.reduce.ps.512"
        return exponents, [call(builder, reduce, LANES_IR, [a, _NEAREST_IS_FLOOR, *rest]) for a in exponents]
    # rounded off by a large number
    shifted = [builder.fadd(a, constant(_ROUNDING)) for a in exponents]
    wholes = [builder.fsub(value, constant(_ROUNDING)) for value in shifted]
    return shifted, [builder.fsub(a, whole) for a, whole in zip(exponents, wholes, strict=True)]


def _polynomials(builder: ir.IRBuilder, fractions: Values) -> Values:
    values: Values = [constant(_COEFFICIENTS[0])] * len(fractions)
    for coefficient in map(constant, _COEFFICIENTS[1:]):
        values = [
            call(builder, "llvm.fmuladd.v16f32", LANES_IR, [value, f, coefficient])
            for value, f in zip(values, fractions, strict=True)
        ]
    return values


def _end(builder: ir.IRBuilder, wholes: Values, values: Values) -> Values:
    """Scaled by the whole parts."""
    if HAS_AVX512:  # one instruction
        scale, rest = "llvm.x86.avx512.mask.scalef.ps.512", [constant(0.0), _ALL, _AS_SET]
        return [call(builder, scale, LANES_IR, [value, a, *rest]) for value, a in zip(values, wholes, strict=True)]
    # which are added to the exponents' bits
    bits = [builder.shl(builder.bitcast(value, INTS_IR), ir.Constant(INTS_IR, [23] * WIDTH)) for value in wholes]
    sums = [builder.add(builder.bitcast(value, INTS_IR), own) for value, own in zip(values, bits, strict=True)]
    return [builder.bitcast(own, LANES_IR) for own in sums]


@intrinsic
def exp2(typing_context: Any, a: Any) -> Any:
    """2^a for a <= 127; what is below -64 counts as -64, so that no product with it is a (slow) subnormal."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        wholes, fractions = _begin(builder, list(arguments))
        return _end(builder, wholes, _polynomials(builder, fractions))[0]

    return lanes(lanes), emit


@intrinsic
def exp2_x4(typing_context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """``exp2`` of each, side by side: one alone is a chain of ten operations that wait for one another."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if HAS_AVX512:
            powers = _four_powers(builder, _no_less_than_lowest(builder, list(arguments)))
        else:
            wholes, fractions = _begin(builder, list(arguments))
            powers = _end(builder, wholes, _polynomials(builder, fractions))
        return context.make_tuple(builder, signature.return_type, powers)

    return types.UniTuple(lanes, 4)(lanes, lanes, lanes, lanes), emit


def _four_powers(builder: ir.IRBuilder, exponents: Values) -> Values:
    """Each step of ``exp2`` for all four before the next step, in an order that LLVM cannot change. LLVM itself would
    do one power after the other, to save registers: the processor would wait through each, twice as long in all.
    """
    powers, fractions, given, table = range(4), range(4, 8), range(8, 12), 12
    lines = [f"vreduceps $$1, ${a}, ${f}" for a, f in zip(given, fractions, strict=True)]
    lines += [f"vbroadcastss (${table}), ${power}" for power in powers]
    for term in range(1, len(_COEFFICIENTS)):
        lines += [
            f"vfmadd213ps {4 * term}(${table}){{1to16}}, ${f}, ${power}"
            for f, power in zip(fractions, powers, strict=True)
        ]
    lines += [f"vscalefps ${a}, ${power}, ${power}" for a, power in zip(given, powers, strict=True)]
    coefficients = ir.Constant(ir.ArrayType(FLOAT, len(_COEFFICIENTS)), list(_COEFFICIENTS))
    pointer = cgutils.global_constant(builder, "exp2_coefficients", coefficients)
    signature = ir.FunctionType(ir.LiteralStructType([LANES_IR] * 8), [LANES_IR] * 4 + [pointer.type])
    constraints = ",".join(["=&v"] * 8 + ["v"] * 4 + ["r"])
    found = builder.asm(signature, "\n".join(lines), constraints, [*exponents, pointer], side_effect=False)
    return [builder.extract_value(found, power) for power in powers]


@intrinsic
def reciprocal(typing_context: Any, a: Any) -> Any:
    """1 / a for normal numbers, to within two units in the last place.

    With AVX-512 an estimate of 14 bits and one Newton step: a division would hold up everything else for
    sixteen cycles.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a = arguments[0]
        if not HAS_AVX512:
            return builder.fdiv(constant(1.0), a)
        estimate = call(builder, "llvm.x86.avx512.rcp14.ps.512", LANES_IR, [a, constant(0.0), _ALL])
        error = call(builder, "llvm.fmuladd.v16f32", LANES_IR, [builder.fneg(a), estimate, constant(1.0)])
        return call(builder, "llvm.fmuladd.v16f32", LANES_IR, [estimate, error, estimate])

    return lanes(lanes), emit
