"""Exponential, sigmoid and tanh of sixteen float32 at a time; softmax and its backward pass.

NaN stays NaN, so that a diverged scene is noticed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined
from ...machine.vector_shuffles import horizontal_max, horizontal_sum
from ...machine.vectors import (
    WIDTH,
    broadcast,
    exp2,
    fma,
    lane_numbers,
    load,
    masked_load,
    masked_store,
    maximum,
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
"""Below this, tanh uses its series, as the quotient of exponentials would lose precision."""
TANH_3, TANH_5 = F(-1.0 / 3.0), F(2.0 / 15.0)
LOWEST = F(-3.0e38)
"""Padding of a softmax's unused lanes."""


@inlined
def exponential(x: Any) -> Any:
    """e^x, clamped: infinite above 88, e^-44 below -44. NaN for NaN and infinities."""
    power = x * broadcast(LOG2_E)
    value = exp2(minimum(power, broadcast(LARGEST_POWER)))
    value = select(power > broadcast(LARGEST_POWER), broadcast(INFINITY), value)
    return fma(x, broadcast(ZERO), value)  # exp2 drops NaN


@inlined
def falling_exponential(x: Any) -> Any:
    """e^x for x <= 0, at least e^-44. NaN for NaN and infinities."""
    return fma(x, broadcast(ZERO), exp2(x * broadcast(LOG2_E)))


@inlined
def sigmoid(x: Any) -> Any:
    return broadcast(ONE) / (broadcast(ONE) + exponential(broadcast(ZERO) - x))


@inlined
def tanh(x: Any) -> Any:
    """Keeps the exact sign near zero, which decides whether a Gaussian is drawn."""
    squared = x * x
    series = x * fma(squared, fma(squared, broadcast(TANH_5), broadcast(TANH_3)), broadcast(ONE))
    power = exponential(minimum(x + x, broadcast(F(40.0))))  # tanh is 1 there, and inf / inf would be NaN
    quotient = (power - broadcast(ONE)) / (power + broadcast(ONE))
    return select(squared < broadcast(SMALL * SMALL), series, quotient)


@inlined
def copy(values: Array, at: int, out: Array, out_at: int, count: int) -> None:
    """Copy ``count`` values from values[at:] to out[out_at:]."""
    whole = count - count % WIDTH
    for c in range(0, whole, WIDTH):
        store(out, out_at + c, load(values, at + c))
    inside = lane_numbers() < broadcast(F(count - whole))
    masked_store(out, out_at + whole, masked_load(values, at + whole, inside), inside)


@device_function
def softmax(values: Array, at: int, out: Array, out_at: int, count: int) -> Any:
    """out[out_at:] = softmax of the ``count`` values[at:]; the two may overlap exactly. Returns the largest value m and
    the sum of e^(value - m)."""
    whole = count - count % WIDTH
    inside = lane_numbers() < broadcast(F(count - whole))
    tail = select(inside, masked_load(values, at + whole, inside), broadcast(LOWEST))
    top = tail
    for c in range(0, whole, WIDTH):
        top = maximum(top, load(values, at + c))
    largest = horizontal_max(top)
    tail = select(inside, falling_exponential(tail - broadcast(largest)), broadcast(ZERO))
    total = tail
    for c in range(0, whole, WIDTH):
        power = falling_exponential(load(values, at + c) - broadcast(largest))
        store(out, out_at + c, power)
        total = total + power
    added = horizontal_sum(total)
    over = broadcast(ONE / added)
    for c in range(0, whole, WIDTH):
        store(out, out_at + c, load(out, out_at + c) * over)
    masked_store(out, out_at + whole, tail * over, inside)
    return largest, added


@device_function
def softmax_backward(p: Array, at: int, g: Array, shift: Any, out: Array, out_at: int, count: int) -> None:
    """out = p (g - sum(p g) + shift): the gradient through a softmax whose values are p, and ``shift`` times p, of
    ``count`` values: p and g from ``at`` on, out from ``out_at`` on."""
    total = broadcast(ZERO)
    whole = count - count % WIDTH
    for c in range(0, whole, WIDTH):
        total = fma(load(p, at + c), load(g, at + c), total)
    inside = lane_numbers() < broadcast(F(count - whole))
    tail_p, tail_g = masked_load(p, at + whole, inside), masked_load(g, at + whole, inside)
    less = broadcast(F(shift) - horizontal_sum(fma(tail_p, tail_g, total)))
    for c in range(0, whole, WIDTH):
        store(out, out_at + c, load(p, at + c) * (load(g, at + c) + less))
    masked_store(out, out_at + whole, tail_p * (tail_g + less), inside)
