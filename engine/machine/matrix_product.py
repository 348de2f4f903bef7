"""The matrix product of the rasteriser's labels and of the decoders: a block of a few rows times up to three vectors
of columns, whose sums stay in registers."""

from __future__ import annotations

from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils

from .compiled import Array, device_function
from .intrinsics import intrinsic
from .vectors import FLOAT, HAS_AVX512, INT, call

COLUMNS = 16 if HAS_AVX512 else 8
"""Columns in one vector of a block: as wide as a register."""
ROWS = 8 if HAS_AVX512 else 4
"""Rows of the largest block: with three vectors each, the sums fill three quarters of the registers."""
FEW_ROWS = 4
"""Rows of the smaller block, for what is left."""

INDEX = ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, COLUMNS)


class Rows(NamedTuple):
    """Row r begins at values[start + r * stride]; ``values`` is flat, contiguous float32, here and below."""

    values: Array
    start: int
    stride: int


class ListedRows(NamedTuple):
    """Row r begins at values[start + numbers[first + r] * stride]; ``numbers`` int32."""

    values: Array
    start: int
    stride: int
    numbers: Array
    first: int


class TwinRows(NamedTuple):
    """Row 2 r begins at values[even + r * stride], row 2 r + 1 at values[odd + r * stride]."""

    values: Array
    even: int
    odd: int
    stride: int


class Factors(NamedTuple):
    """The factor of row a of the result and row b of the source is values[start + a * across + b * along]."""

    values: Array
    start: int
    across: int
    along: int


class _Emitter:
    """Writes one block's code: ``rows`` rows of the result and ``vectors`` vectors of columns, from row ``a`` and
    column ``c`` on. ``kinds`` are Numba's types of (out, factors, source)."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kinds: Any, rows: int, vectors: int) -> None:
        self.context, self.builder, self.kinds = context, builder, kinds
        self.rows, self.vectors = rows, vectors

    def fields(self, place: int, value: ir.Value) -> list[ir.Value]:
        """The tuple's fields, its arrays as pointers to their first element."""
        fields = cgutils.unpack_tuple(self.builder, value)
        kinds = self.kinds[place].types
        return [
            self.context.make_array(kind)(self.context, self.builder, field).data
            if isinstance(kind, types.Array)
            else field
            for kind, field in zip(kinds, fields, strict=True)
        ]

    def row(self, place: int, fields: list[ir.Value], number: ir.Value) -> ir.Value:
        """Pointer to a row of ``Rows`` or ``ListedRows``."""
        values, start, stride = fields[:3]
        if self.kinds[place].instance_class is ListedRows:
            listed = self.builder.gep(fields[3], [self.builder.add(fields[4], number)])
            number = self.builder.sext(self.builder.load(listed), INDEX)
        return self.builder.gep(values, [self.builder.add(start, self.builder.mul(number, stride))])

    def vector(self, row: ir.Value, c: ir.Value, vector: int) -> ir.Value:
        """Pointer to a vector of a row."""
        at = self.builder.gep(row, [self.builder.add(c, INDEX(vector * COLUMNS))])
        return self.builder.bitcast(at, VECTOR.as_pointer())

    def emit(self, values: list[ir.Value]) -> None:
        builder, (a, c, count) = self.builder, values[3:]
        out, factors, source = (self.fields(place, value) for place, value in enumerate(values[:3]))
        numbers = [builder.add(a, INDEX(row)) for row in range(self.rows)]
        outs = [self.row(0, out, number) for number in numbers]
        base, start, across, along = factors
        lefts = [builder.gep(base, [builder.add(start, builder.mul(number, across))]) for number in numbers]
        sums = [
            [
                cgutils.alloca_once_value(builder, builder.load(self.vector(row, c, v), align=4))
                for v in range(self.vectors)
            ]
            for row in outs
        ]
        twins = self.kinds[2].instance_class is TwinRows
        turns = 2 if twins else 1
        with cgutils.for_range(builder, builder.udiv(count, INDEX(turns))) as loop:
            for turn in range(turns):
                if twins:
                    offset = builder.add(source[1 + turn], builder.mul(loop.index, source[3]))
                    row = builder.gep(source[0], [offset])
                else:
                    row = self.row(2, source, loop.index)
                b = builder.add(builder.mul(loop.index, INDEX(turns)), INDEX(turn))
                step = builder.mul(b, along)
                self.add_row(sums, [builder.gep(left, [step]) for left in lefts], row, c)
        for row, own in zip(outs, sums, strict=True):
            for v in range(self.vectors):
                builder.store(builder.load(own[v]), self.vector(row, c, v), align=4)

    def add_row(self, sums: Any, lefts: list[ir.Value], row: ir.Value, c: ir.Value) -> None:
        """Add one row of the source, times its factors, to all sums."""
        builder = self.builder
        loaded = [builder.load(self.vector(row, c, v), align=4) for v in range(self.vectors)]
        for own, left in zip(sums, lefts, strict=True):
            factor = _in_all_lanes(builder, builder.load(left))
            for v in range(self.vectors):
                product = [factor, loaded[v], builder.load(own[v])]
                builder.store(call(builder, f"llvm.fmuladd.v{COLUMNS}f32", VECTOR, product), own[v])


def _in_all_lanes(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    single = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), scalar, INT(0))
    lanes = ir.Constant(ir.VectorType(INT, COLUMNS), [0] * COLUMNS)
    return builder.shuffle_vector(single, ir.Constant(VECTOR, ir.Undefined), lanes)


def _block(rows: int, vectors: int) -> Any:
    @intrinsic
    def block(typing_context: Any, out: Any, factors: Any, source: Any, a: Any, c: Any, count: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            _Emitter(context, builder, signature.args[:3], rows, vectors).emit(list(arguments))
            return context.get_dummy_value()

        i = types.int64
        return types.void(out, factors, source, i, i, i), emit

    return block


_many_3, _many_2, _many_1 = (_block(ROWS, vectors) for vectors in (3, 2, 1))
_few_3, _few_2, _few_1 = (_block(FEW_ROWS, vectors) for vectors in (3, 2, 1))


@device_function
def add_product(out: Any, factors: Any, source: Any, rows: int, columns: int, count: int) -> None:
    """out[a, c] += sum_b factor[a, b] * source[b, c] for a < ``rows``, c < ``columns``, b < ``count``.

    ``out`` is ``Rows`` or ``ListedRows``, ``source`` these or ``TwinRows`` (then ``count`` is even), ``factors`` is
    ``Factors``. ``columns`` is a multiple of 16. Rows are taken eight or four at a time, so memory must reach to the
    next multiple of eight, or of four where ``rows`` is one. Summed in ascending order of b.
    """
    c = 0
    while c < columns:
        vectors = (columns - c) // COLUMNS
        vectors = 2 if vectors == 4 else min(vectors, 3)  # 2 + 2 is faster than 3 + 1
        a = 0
        while a < rows:
            if rows - a > FEW_ROWS or ROWS == FEW_ROWS:
                if vectors == 3:
                    _many_3(out, factors, source, a, c, count)
                elif vectors == 2:
                    _many_2(out, factors, source, a, c, count)
                else:
                    _many_1(out, factors, source, a, c, count)
                a += ROWS
            else:
                if vectors == 3:
                    _few_3(out, factors, source, a, c, count)
                elif vectors == 2:
                    _few_2(out, factors, source, a, c, count)
                else:
                    _few_1(out, factors, source, a, c, count)
                a += FEW_ROWS
        c += vectors * COLUMNS
