"""Softmax of a batch's logits, sixteen anchors side by side, and the way back through it."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

from ...machine.compiled import Array, device_function, inlined
from ...machine.vectors import (
    INTS_IR,
    LANES_IR,
    WIDTH,
    broadcast,
    element_pointer,
    fma,
    intrinsic,
    lane_numbers,
    load,
    masked_load,
    masked_store,
    maximum,
    store,
)
from .activations import LOWEST, falling_exponential, sum_of

F = np.float32
ZERO, ONE = F(0.0), F(1.0)


@intrinsic
def transpose(
    typing_context: Any, source: Any, source_at: Any, source_stride: Any, out: Any, out_at: Any, out_stride: Any
) -> Any:
    """out[j, i] = source[i, j] of sixteen by sixteen float32; rows start a stride apart; all is read before it is
    written."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def row(place: int, number: int) -> ir.Value:
            start = element_pointer(context, builder, signature.args[place], arguments[place], arguments[place + 1])
            there = builder.gep(start, [builder.mul(ir.IntType(64)(number), arguments[place + 2])])
            return builder.bitcast(there, LANES_IR.as_pointer())

        half = WIDTH // 2
        shuffles = [
            ir.Constant(INTS_IR, [place for lane in range(start, start + half) for place in (lane, lane + WIDTH)])
            for start in (0, half)
        ]
        rows = [builder.load(row(0, number), align=4) for number in range(WIDTH)]
        for _ in range(4):  # each round interleaves the halves: four make the transpose
            pairs = zip(rows[:half], rows[half:], strict=True)
            rows = [builder.shuffle_vector(a, b, shuffle) for a, b in pairs for shuffle in shuffles]
        for number, values in enumerate(rows):
            builder.store(values, row(3, number), align=4)
        return context.get_dummy_value()

    i = types.int64
    return types.void(source, i, i, out, i, i), emit


@device_function
def soften(values: Array, at: int, stride: int, rows: int, k: int, count: int, tall: int, sums: int) -> None:
    """In place, the softmax of each of the k runs of ``count`` values in every row; rows are ``stride`` (a multiple of
    16) floats apart and ``rows`` is rounded up to a multiple of 16.

    Two places more in ``values``: from ``tall`` on, ``stride`` x 16 floats to work in; from ``sums`` on come the
    largest logits m [k, rounded rows], then the sums of e^(logit - m), likewise.
    """
    rounded = (rows + WIDTH - 1) // WIDTH * WIDTH
    for i in range(0, rounded, WIDTH):
        block = at + i * stride
        for c in range(0, stride, WIDTH):
            transpose(values, block + c, stride, values, tall + c * WIDTH, WIDTH)
        for g in range(k):
            first = tall + g * count * WIDTH
            after = first + count * WIDTH
            top = broadcast(LOWEST)
            for c in range(first, after, WIDTH):
                top = maximum(top, load(values, c))
            total = broadcast(ZERO)
            for c in range(first, after, WIDTH):
                power = falling_exponential(load(values, c) - top)
                store(values, c, power)
                total = total + power
            share = broadcast(ONE) / total
            for c in range(first, after, WIDTH):
                store(values, c, load(values, c) * share)
            store(values, sums + g * rounded + i, top)
            store(values, sums + (k + g) * rounded + i, total)
        for c in range(0, stride, WIDTH):
            transpose(values, tall + c * WIDTH, WIDTH, values, block + c, stride)


@inlined
def soften_back(p: Array, at: int, g: Array, g_at: int, shift: Any, out: Array, out_at: int, count: int) -> None:
    """out = p (g - sum(p g) + shift): the gradient through a softmax whose values are p, and ``shift`` times p.

    ``count`` values from ``at``, ``g_at`` and ``out_at`` on.
    """
    total = broadcast(ZERO)
    whole = count - count % WIDTH
    for c in range(0, whole, WIDTH):
        total = fma(load(p, at + c), load(g, g_at + c), total)
    inside = lane_numbers() < broadcast(F(count - whole))
    rest_p, rest_g = masked_load(p, at + whole, inside), masked_load(g, g_at + whole, inside)
    less = broadcast(F(shift) - sum_of(fma(rest_p, rest_g, total)))
    for c in range(0, whole, WIDTH):
        store(out, out_at + c, load(p, at + c) * (load(g, g_at + c) + less))
    masked_store(out, out_at + whole, rest_p * (rest_g + less), inside)
