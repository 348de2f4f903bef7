"""Exponential, sigmoid and tanh of sixteen float32 values at a time; softmax and its backward pass. NaN stays NaN, so
that a diverged scene is noticed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine import vectors as v
from ...machine.compiled import Array, device_function, inlined
from ...machine.vector_shuffles import horizontal_max, horizontal_sum

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
    """Return e^x, clamped: infinity if x > 88, e^-44 if x < -44. NaN for NaN and for infinite x."""
    power = x * v.broadcast(LOG2_E)
    value = v.exp2(v.minimum(power, v.broadcast(LARGEST_POWER)))
    value = v.select(power > v.broadcast(LARGEST_POWER), v.broadcast(INFINITY), value)
    return v.fma(x, v.broadcast(ZERO), value)  # exp2 drops NaN


@inlined
def falling_exponential(x: Any) -> Any:
    """Return e^x for x <= 0, but at least e^-44. NaN for NaN and for infinite x."""
    return v.fma(x, v.broadcast(ZERO), v.exp2(x * v.broadcast(LOG2_E)))


@inlined
def sigmoid(x: Any) -> Any:
    return v.broadcast(ONE) / (v.broadcast(ONE) + exponential(v.broadcast(ZERO) - x))


@inlined
def tanh(x: Any) -> Any:
    """Return tanh x, of the exact sign even near 0, which decides whether a Gaussian is drawn."""
    squared = x * x
    series = x * v.fma(squared, v.fma(squared, v.broadcast(TANH_5), v.broadcast(TANH_3)), v.broadcast(ONE))
    power = exponential(v.minimum(x + x, v.broadcast(F(40.0))))  # tanh is 1 there, and inf / inf would be NaN
    quotient = (power - v.broadcast(ONE)) / (power + v.broadcast(ONE))
    return v.select(squared < v.broadcast(SMALL * SMALL), series, quotient)


@inlined
def copy(values: Array, at: int, out: Array, out_at: int, count: int) -> None:
    """Copy ``count`` values from values[at:] to out[out_at:]."""
    whole = count - count % v.WIDTH
    for c in range(0, whole, v.WIDTH):
        v.store(out, out_at + c, v.load(values, at + c))
    inside = v.lane_numbers() < v.broadcast(F(count - whole))
    v.masked_store(out, out_at + whole, v.masked_load(values, at + whole, inside), inside)


@device_function
def softmax(values: Array, at: int, out: Array, out_at: int, count: int) -> Any:
    """Write the softmax of the ``count`` values[at:] to out[out_at:], which may be the same place. Return the largest
    value m, and the sum of e^(value - m)."""
    whole = count - count % v.WIDTH
    inside = v.lane_numbers() < v.broadcast(F(count - whole))
    tail = v.select(inside, v.masked_load(values, at + whole, inside), v.broadcast(LOWEST))
    top = tail
    for c in range(0, whole, v.WIDTH):
        top = v.maximum(top, v.load(values, at + c))
    largest = horizontal_max(top)
    tail = v.select(inside, falling_exponential(tail - v.broadcast(largest)), v.broadcast(ZERO))
    total = tail
    for c in range(0, whole, v.WIDTH):
        power = falling_exponential(v.load(values, at + c) - v.broadcast(largest))
        v.store(out, out_at + c, power)
        total = total + power
    added = horizontal_sum(total)
    over = v.broadcast(ONE / added)
    for c in range(0, whole, v.WIDTH):
        v.store(out, out_at + c, v.load(out, out_at + c) * over)
    v.masked_store(out, out_at + whole, tail * over, inside)
    return largest, added


@device_function
def softmax_backward(p: Array, at: int, g: Array, shift: Any, out: Array, out_at: int, count: int) -> None:
    """Write p (g - sum(p g) + shift) to out[out_at:]: the gradient through a softmax with ``count`` values p[at:],
    given the gradient g[at:] of these, plus ``shift`` times p."""
    total = v.broadcast(ZERO)
    whole = count - count % v.WIDTH
    for c in range(0, whole, v.WIDTH):
        total = v.fma(v.load(p, at + c), v.load(g, at + c), total)
    inside = v.lane_numbers() < v.broadcast(F(count - whole))
    tail_p, tail_g = v.masked_load(p, at + whole, inside), v.masked_load(g, at + whole, inside)
    less = v.broadcast(F(shift) - horizontal_sum(v.fma(tail_p, tail_g, total)))
    for c in range(0, whole, v.WIDTH):
        v.store(out, out_at + c, v.load(p, at + c) * (v.load(g, at + c) + less))
    v.masked_store(out, out_at + whole, tail_p * (tail_g + less), inside)
