"""Move float32 between the sixteen lanes of vectors: sums of lanes, pixels to planes, rows to patches, and back."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from .vectors import FLOAT, INT, INTS_IR, WIDTH, call, constant, intrinsic, lanes, of_values


@intrinsic
def horizontal_sums(typing_context: Any, vectors: Any) -> Any:
    """Sum the lanes of each vector in a tuple of at most sixteen. Lane i of the result is the sum of vector i; the
    other lanes are 0. The pairwise sums are a tree, always in the same order."""

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


def _fold(builder: ir.IRBuilder, a: ir.Value | None, b: ir.Value | None, width: int, half: int) -> ir.Value | None:
    """Add the two halves of each group of ``width`` partial sums in the vectors ``a`` and ``b``. Returns one vector of
    groups of ``half``: those of a, then those of b."""
    if a is None:
        return None
    b = constant(0.0) if b is None else b
    groups = range(0, 2 * WIDTH, width)
    low = [group + lane for group in groups for lane in range(half)]
    high = [group + half + lane for group in groups for lane in range(half)]
    return builder.fadd(_shuffled(builder, a, b, low), _shuffled(builder, a, b, high))


def _shuffled(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, indices: list[int]) -> ir.Value:
    return builder.shuffle_vector(a, b, ir.Constant(INTS_IR, indices))


def _to_pixels(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> list[ir.Value]:
    vectors = []
    for start in range(0, 3 * WIDTH, WIDTH):
        indices = [divmod(start + lane, 3) for lane in range(WIDTH)]
        pairs = _shuffled(builder, a, b, [pixel + WIDTH * (plane == 1) for pixel, plane in indices])
        mixed = [WIDTH + pixel if plane == 2 else lane for lane, (pixel, plane) in enumerate(indices)]
        vectors.append(_shuffled(builder, pairs, c, mixed))
    return vectors


def _to_planes(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> list[ir.Value]:
    planes = []
    for plane in range(3):
        indices = [3 * lane + plane for lane in range(WIDTH)]
        both = _shuffled(builder, a, b, [index if index < 2 * WIDTH else 0 for index in indices])
        mixed = [WIDTH + index - 2 * WIDTH if index >= 2 * WIDTH else lane for lane, index in enumerate(indices)]
        planes.append(_shuffled(builder, both, c, mixed))
    return planes


def _total(builder: ir.IRBuilder, a: ir.Value) -> ir.Value:
    for half in (8, 4, 2, 1):
        a = builder.fadd(a, _shuffled(builder, a, a, [(lane + half) % WIDTH for lane in range(WIDTH)]))
    return builder.extract_element(a, INT(0))


_two, _three = types.UniTuple(lanes, 2), types.UniTuple(lanes, 3)
interleave3 = of_values("interleave3", _three, (lanes, lanes, lanes), _to_pixels)
"""interleave3(a, b, c): a0 b0 c0 a1 b1 c1 ... c15 as three vectors: planes to pixels."""
deinterleave3 = of_values("deinterleave3", _three, (lanes, lanes, lanes), _to_planes)
"""The inverse of ``interleave3``: pixels to planes."""
_halves = [[lane + WIDTH * other for lane in range(at, at + WIDTH // 2) for other in (0, 1)] for at in (0, WIDTH // 2)]
interleave2 = of_values(
    "interleave2", _two, (lanes, lanes), lambda builder, a, b: [_shuffled(builder, a, b, half) for half in _halves]
)
"""interleave2(a, b): a0 b0 a1 b1 ... a15 b15 as two vectors."""
_every_second = [list(range(first, 2 * WIDTH, 2)) for first in (0, 1)]
deinterleave2 = of_values(
    "deinterleave2",
    _two,
    (lanes, lanes),
    lambda builder, a, b: [_shuffled(builder, a, b, own) for own in _every_second],
)
"""The inverse of ``interleave2``."""
horizontal_max = of_values(
    "horizontal_max",
    types.float32,
    (lanes,),
    lambda builder, a: call(builder, "llvm.vector.reduce.fmax.v16f32", FLOAT, [a]),
)
"""horizontal_max(a): the largest lane. No lane may be NaN."""
horizontal_sum = of_values("horizontal_sum", types.float32, (lanes,), _total)
"""horizontal_sum(a): the sum of the lanes, halves first: always in the same order."""
