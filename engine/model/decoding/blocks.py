"""The matrix product of both passes: a block of a few rows times up to three vectors of columns, kept in registers."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from ...machine.compiled import Array, device_function
from ...machine.intrinsics import element_pointer, intrinsic
from ...machine.vectors import FLOAT, HAS_AVX512, INT, call

COLUMNS = 16 if HAS_AVX512 else 8
"""Columns in one vector of a block: as wide as a register."""
ROWS = 8 if HAS_AVX512 else 4
"""Rows of a block: with three vectors each, the sums fill three quarters of the registers."""

INDEX = ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, COLUMNS)


def _splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    single = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), scalar, INT(0))
    lanes = ir.Constant(ir.VectorType(INT, COLUMNS), [0] * COLUMNS)
    return builder.shuffle_vector(single, ir.Constant(VECTOR, ir.Undefined), lanes)


def _block(vectors: int) -> Any:
    """out[a, :] += sum_b left[a * across + b * along] * right[b, :] for ``ROWS`` rows a and ``vectors`` vectors of
    columns."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def start(place: int) -> ir.Value:
            return element_pointer(context, builder, signature.args[place], arguments[place], arguments[place + 1])

        out, left, right = start(0), start(3), start(7)
        out_stride, (across, along), (right_stride, count) = arguments[2], arguments[5:7], arguments[9:11]

        def vector_at(row: ir.Value, vector: int) -> ir.Value:
            return builder.bitcast(builder.gep(row, [INDEX(vector * COLUMNS)]), VECTOR.as_pointer())

        rows = [builder.gep(out, [builder.mul(INDEX(a), out_stride)]) for a in range(ROWS)]
        lefts = [builder.gep(left, [builder.mul(INDEX(a), across)]) for a in range(ROWS)]
        sums = [
            [cgutils.alloca_once_value(builder, builder.load(vector_at(row, v), align=4)) for v in range(vectors)]
            for row in rows
        ]
        with cgutils.for_range(builder, count) as loop:
            row = builder.gep(right, [builder.mul(loop.index, right_stride)])
            values = [builder.load(vector_at(row, v), align=4) for v in range(vectors)]
            step = builder.mul(loop.index, along)
            for a in range(ROWS):
                factor = _splat(builder, builder.load(builder.gep(lefts[a], [step])))
                for v in range(vectors):
                    product = [factor, values[v], builder.load(sums[a][v])]
                    builder.store(call(builder, f"llvm.fmuladd.v{COLUMNS}f32", VECTOR, product), sums[a][v])
        for a in range(ROWS):
            for v in range(vectors):
                builder.store(builder.load(sums[a][v]), vector_at(rows[a], v), align=4)
        return context.get_dummy_value()

    @intrinsic
    def block(
        typing_context: Any,
        out: Any,
        out_at: Any,
        out_stride: Any,
        left: Any,
        left_at: Any,
        across: Any,
        along: Any,
        right: Any,
        right_at: Any,
        right_stride: Any,
        count: Any,
    ) -> Any:
        i = types.int64
        return types.void(out, i, i, left, i, i, i, right, i, i, i), emit

    return block


_block_3, _block_2, _block_1 = (_block(vectors) for vectors in (3, 2, 1))


@device_function
def add_product(
    out: Array,
    out_at: int,
    out_stride: int,
    left: Array,
    left_at: int,
    across: int,
    along: int,
    right: Array,
    right_at: int,
    right_stride: int,
    rows: int,
    columns: int,
    count: int,
) -> None:
    """out[a, c] += sum_b left[a, b] * right[b, c] for a < ``rows``, c < ``columns``, b < ``count``; flat float32.

    Row a of ``out`` starts at ``out_at`` + a * ``out_stride``, of ``right`` likewise; element (a, b) of ``left`` lies
    at ``left_at`` + a * ``across`` + b * ``along``. ``columns`` is a multiple of 16. Rows are taken up to eight at a
    time, so memory must reach to the next multiple of eight. Summed in ascending order of b.
    """
    at = 0
    while at < columns:
        vectors = (columns - at) // COLUMNS
        vectors = 2 if vectors == 4 else min(vectors, 3)  # 2 + 2 is faster than 3 + 1
        for a in range(0, rows, ROWS):
            o, f = out_at + a * out_stride + at, left_at + a * across
            if vectors == 3:
                _block_3(out, o, out_stride, left, f, across, along, right, right_at + at, right_stride, count)
            elif vectors == 2:
                _block_2(out, o, out_stride, left, f, across, along, right, right_at + at, right_stride, count)
            else:
                _block_1(out, o, out_stride, left, f, across, along, right, right_at + at, right_stride, count)
        at += vectors * COLUMNS
