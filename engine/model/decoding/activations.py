"""Exponential, sigmoid and tanh of sixteen float32 at a time. NaN stays NaN, so that a diverged scene shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine.compiled import Array, inlined
from ...machine.vectors import (
    WIDTH,
    broadcast,
    exp2,
    fma,
    lane_numbers,
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
SMALL = F(0.1)
"""Below this, tanh is taken from its series: the quotient of exponentials would lose its digits."""
TANH_3, TANH_5 = F(-1.0 / 3.0), F(2.0 / 15.0)


@inlined
def exponential(x: Any) -> Any:
    """e^x of a number; infinite above 88, e^-44 below -44. NaN of what is not finite."""
    power = x * broadcast(LOG2_E)
    value = exp2(minimum(power, broadcast(LARGEST_POWER)))
    value = select(power > broadcast(LARGEST_POWER), broadcast(INFINITY), value)
    return fma(x, broadcast(ZERO), value)  # exp2 drops NaN


@inlined
def falling_exponential(x: Any) -> Any:
    """e^x of a number <= 0; e^-44 below -44. NaN of what is not finite."""
    return fma(x, broadcast(ZERO), exp2(x * broadcast(LOG2_E)))


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
def copy(values: Array, at: int, out: Array, out_at: int, count: int) -> None:
    """out = values, ``count`` of them from ``at`` and ``out_at`` on."""
    whole = count - count % WIDTH
    for c in range(0, whole, WIDTH):
        store(out, out_at + c, load(values, at + c))
    inside = lane_numbers() < broadcast(F(count - whole))
    masked_store(out, out_at + whole, masked_load(values, at + whole, inside), inside)
