"""The matrix product of both passes, as one block held in registers: a few rows times up to three vectors of
channels. In a patch's weights, the pixels of its two rows alternate."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from ...machine.emitting import element, intrinsic
from ...machine.vectors import FLOAT, INT, WIDE, WIDTH, call
from ..records import PATCH_HEIGHT

INDEX = ir.IntType(64)


BLOCK = 16 if WIDE else 8
"""Channels in one vector of a block: as wide as a register."""
ROWS = 8 if WIDE else 4
"""Rows of the largest block: with three vectors each, the sums fill three quarters of the registers."""
BLOCK_IR = ir.VectorType(FLOAT, BLOCK)


def _splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    single = builder.insert_element(ir.Constant(BLOCK_IR, ir.Undefined), scalar, INT(0))
    lanes = ir.Constant(ir.VectorType(INT, BLOCK), [0] * BLOCK)
    return builder.shuffle_vector(single, ir.Constant(BLOCK_IR, ir.Undefined), lanes)


def _emit_block(context: Any, builder: ir.IRBuilder, pointers: dict[str, Any], rows: int, vectors: int) -> None:
    """out[row a] += sum_b weight[a * across + b * along] * source[row b], b < count; a < rows; all in
    registers. There may be several sources: then there are ``count`` rows of each, which take turns, and so do their
    weights.

    ``out_rows`` and ``source_rows`` are int32 lists, or None where row a is simply a. ``stride`` and
    ``source_stride`` are the floats from one row to the next.
    """
    stride = pointers["stride"]

    def row_of(name: str, place: ir.Value) -> ir.Value:
        listed = pointers[name]
        if listed is None:
            return place
        return builder.sext(builder.load(builder.gep(listed, [place])), INDEX)

    outs = [builder.gep(pointers["out"], [builder.mul(row_of("out_rows", INDEX(a)), stride)]) for a in range(rows)]

    def vector_at(base: ir.Value, vector: int) -> ir.Value:
        return builder.bitcast(builder.gep(base, [INDEX(vector * BLOCK)]), BLOCK_IR.as_pointer())

    sums = [
        [cgutils.alloca_once_value(builder, builder.load(vector_at(out, v), align=4)) for v in range(vectors)]
        for out in outs
    ]
    with cgutils.for_range(builder, pointers["count"]) as loop:
        row = builder.mul(row_of("source_rows", loop.index), pointers["source_stride"])
        sources = pointers["sources"]
        for turn, base in enumerate(sources):
            source = builder.gep(base, [row])
            features = [builder.load(vector_at(source, v), align=4) for v in range(vectors)]
            place = builder.add(builder.mul(loop.index, INDEX(len(sources))), INDEX(turn))
            weights = builder.gep(pointers["weights"], [builder.mul(place, pointers["along"])])
            for a in range(rows):
                at = builder.gep(weights, [builder.mul(INDEX(a), pointers["across"])])
                weight = _splat(builder, builder.load(at))
                for v in range(vectors):
                    total = builder.load(sums[a][v])
                    total = call(builder, f"llvm.fmuladd.v{BLOCK}f32", BLOCK_IR, [weight, features[v], total])
                    builder.store(total, sums[a][v])
    for a in range(rows):
        for v in range(vectors):
            builder.store(builder.load(sums[a][v]), vector_at(outs[a], v), align=4)


def _offset(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any, place: int) -> ir.Value:
    return element(context, builder, signature.args[place], arguments[place], arguments[place + 1])


def _blend_block(rows: int, vectors: int) -> Any:
    @intrinsic
    def block(
        typing_context: Any,
        out: Any,
        out_at: Any,
        source: Any,
        source_at: Any,
        members: Any,
        members_at: Any,
        weights: Any,
        weights_at: Any,
        count: Any,
        stride: Any,
    ) -> Any:
        def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointers = {
                "out": _offset(context, builder, signature, arguments, 0),
                "sources": [_offset(context, builder, signature, arguments, 2)],
                "source_rows": _offset(context, builder, signature, arguments, 4),
                "weights": _offset(context, builder, signature, arguments, 6),
                "out_rows": None,
                "count": arguments[8],
                "stride": arguments[9],
                "source_stride": INDEX(WIDTH),
                "across": INDEX(PATCH_HEIGHT),
                "along": INDEX(WIDTH),
            }
            _emit_block(context, builder, pointers, rows, vectors)
            return context.get_dummy_value()

        index = types.int64
        return types.void(out, index, source, index, members, index, weights, index, index, index), emit

    return block


def _unblend_block(rows: int, vectors: int) -> Any:
    @intrinsic
    def block(
        typing_context: Any,
        out: Any,
        out_at: Any,
        members: Any,
        members_at: Any,
        source: Any,
        upper_at: Any,
        lower_at: Any,
        weights: Any,
        weights_at: Any,
        stride: Any,
        source_stride: Any,
    ) -> Any:
        def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointers = {
                "out": _offset(context, builder, signature, arguments, 0),
                "out_rows": _offset(context, builder, signature, arguments, 2),
                "sources": [element(context, builder, signature.args[4], arguments[4], at) for at in arguments[5:7]],
                "weights": _offset(context, builder, signature, arguments, 7),
                "source_rows": None,
                "count": INDEX(WIDTH // PATCH_HEIGHT),
                "stride": arguments[9],
                "source_stride": arguments[10],
                "across": INDEX(WIDTH),
                "along": INDEX(1),
            }
            _emit_block(context, builder, pointers, rows, vectors)
            return context.get_dummy_value()

        index = types.int64
        return types.void(out, index, members, index, source, index, index, weights, index, index, index), emit

    return block


blend_3, blend_2, blend_1 = (_blend_block(ROWS, vectors) for vectors in (3, 2, 1))
unblend_3, unblend_2, unblend_1 = (_unblend_block(ROWS, vectors) for vectors in (3, 2, 1))
unblend_four_3, unblend_four_2, unblend_four_1 = (_unblend_block(4, vectors) for vectors in (3, 2, 1))
