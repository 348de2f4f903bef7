"""The matrix product for the rasteriser's labels and for the decoders. It computes blocks of four rows and sixteen
columns, whose sums stay in registers."""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.extending import overload

from .compiled import Array, device_function
from .vectors import WIDTH, broadcast_load, fma, get, load, store


class Rows(NamedTuple):
    """A matrix: row r begins at values[start + r * stride]; ``values`` is flat, contiguous float32, here and below."""

    values: Array
    start: int
    stride: int


class ListedRows(NamedTuple):
    """A matrix of listed rows: row r begins at values[start + numbers[first + r] * stride]; ``numbers`` int32."""

    values: Array
    start: int
    stride: int
    numbers: Array
    first: int


class Factors(NamedTuple):
    """The left matrix of a product: its factor for row a and source row b is values[start + a * across + b * along]."""

    values: Array
    start: int
    across: int
    along: int


def begin_of(rows: Any, number: int) -> int:
    """Return where a row of ``Rows`` or ``ListedRows`` begins, for kernels, which use the overload below."""
    raise NotImplementedError


@overload(begin_of, inline="always")
def _begin_of(rows, number):
    if rows.instance_class is Rows:
        return lambda rows, number: rows.start + number * rows.stride
    return lambda rows, number: rows.start + get(rows.numbers, rows.first + number) * rows.stride


@device_function
def add_four_rows(out: Any, factors: Any, source: Any, a: int, c: int, count: int) -> None:
    """Add rows ``a`` to a + 3 and columns ``c`` to c + 15 of the product, a sum of ``count`` terms, to ``out``. The
    sums are separate variables, because registers have no index; with AVX2 they take half of the registers."""
    o0, o1, o2, o3 = begin_of(out, a) + c, begin_of(out, a + 1) + c, begin_of(out, a + 2) + c, begin_of(out, a + 3) + c
    s0, s1, s2, s3 = load(out.values, o0), load(out.values, o1), load(out.values, o2), load(out.values, o3)
    values, across, at = factors.values, factors.across, factors.start + a * factors.across
    for b in range(count):
        row = load(source.values, begin_of(source, b) + c)
        s0 = fma(broadcast_load(values, at), row, s0)
        s1 = fma(broadcast_load(values, at + across), row, s1)
        s2 = fma(broadcast_load(values, at + 2 * across), row, s2)
        s3 = fma(broadcast_load(values, at + 3 * across), row, s3)
        at += factors.along
    store(out.values, o0, s0)
    store(out.values, o1, s1)
    store(out.values, o2, s2)
    store(out.values, o3, s3)


@device_function
def add_product(out: Any, factors: Factors, source: Any, rows: int, columns: int, count: int) -> None:
    """out[a, c] += sum_b factor[a, b] * source[b, c] for a < ``rows``, c < ``columns``, b < ``count``. ``out`` and
    ``source`` are ``Rows`` or ``ListedRows``. ``rows`` is a multiple of 4 and ``columns`` of 16. The sum is in
    ascending order of b."""
    for c in range(0, columns, WIDTH):
        for a in range(0, rows, 4):
            add_four_rows(out, factors, source, a, c, count)
