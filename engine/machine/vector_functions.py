"""Powers of two of sixteen float32 at a time."""

from __future__ import annotations

from llvmlite import ir
from numba import types

from .vectors import INTS_IR, LANES_IR, WIDTH, call, constant, lanes, of_values

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
    """Do each step for all exponents before the next step."""
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
"""exp2_x4(a, b, c, d): ``exp2`` of each, side by side: a single one is a chain of ten operations that wait for one
another."""
