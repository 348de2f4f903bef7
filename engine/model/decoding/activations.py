"""Exponential, sigmoid and tanh of sixteen float32 at a time. NaN stays NaN, so that a diverged scene shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

from ...machine.compiled import Array, inlined
from ...machine.vector_functions import exp2
from ...machine.vectors import (
    INT,
    INTS_IR,
    LANES_IR,
    WIDTH,
    broadcast,
    fma,
    intrinsic,
    lane_numbers,
    lanes,
    load,
    masked_load,
    masked_store,
    minimum,
    select,
    store,
)

F = np.float32
ZERO, ONE = F(0.0), F(1.0)
LOG2_E = F(1.0 / math.log(2.0))
LARGEST_POWER = F(127.0)
INFINITY = F(math.inf)
LOWEST = F(-3.0e38)
SMALL = F(0.1)
"""Below this, tanh is taken from its series: the quotient of exponentials would lose its digits."""
TANH_3, TANH_5 = F(-1.0 / 3.0), F(2.0 / 15.0)


@intrinsic
def sum_of(typing_context: Any, values: Any) -> Any:
    """The sum of the lanes, halves first: always in the same order."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value, nothing = arguments[0], ir.Constant(LANES_IR, ir.Undefined)
        for half in (8, 4, 2, 1):
            order = ir.Constant(INTS_IR, [(lane + half) % WIDTH for lane in range(WIDTH)])
            value = builder.fadd(value, builder.shuffle_vector(value, nothing, order))
        return builder.extract_element(value, INT(0))

    return types.float32(lanes), emit


@inlined
def exponential(x: Any) -> Any:
    """e^x of a number; infinite above 88, e^-44 below -44. NaN of what is not finite."""
    power = x * broadcast(LOG2_E)
    value = exp2(minimum(power, broadcast(LARGEST_POWER)))
    value = select(power > broadcast(LARGEST_POWER), broadcast(INFINITY), value)
    return fma(x, broadcast(ZERO), value)  # exp2 drops NaN


@inlined
def sigmoid(x: Any) -> Any:
    return broadcast(ONE) / (broadcast(ONE) + exponential(broadcast(ZERO) - x))


@inlined
def tanh(x: Any) -> Any:
    """Exact sign, also next to zero: whether a Gaussian is drawn depends on it."""
    squared = x * x
    series = x * fma(squared, fma(squared, broadcast(TANH_5), broadcast(TANH_3)), broadcast(ONE))
    power = exponential(minimum(x + x, broadcast(F(40.0))))
    quotient = (power - broadcast(ONE)) / (power + broadcast(ONE))
    return select(squared < broadcast(SMALL * SMALL), series, quotient)


@inlined
def falling_exponential(x: Any) -> Any:
    """e^x of a number <= 0; e^-44 below -44. NaN of what is not finite."""
    return fma(x, broadcast(ZERO), exp2(x * broadcast(LOG2_E)))


@inlined
def copy(values: Array, at: int, out: Array, out_at: int, count: int) -> None:
    """out = values, ``count`` of them from ``at`` and ``out_at`` on."""
    whole = count - count % WIDTH
    for c in range(0, whole, WIDTH):
        store(out, out_at + c, load(values, at + c))
    rest = lane_numbers() < broadcast(F(count - whole))
    masked_store(out, out_at + whole, masked_load(values, at + whole, rest), rest)
