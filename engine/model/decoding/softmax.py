"""Softmax of a run of float32, sixteen at a time, and its backward pass. NaN stays NaN, so that divergence shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function
from ...machine.vector_shuffles import horizontal_max, horizontal_sum
from ...machine.vectors import (
    WIDTH,
    broadcast,
    fma,
    lane_numbers,
    load,
    masked_load,
    masked_store,
    maximum,
    select,
    store,
)
from .activations import falling_exponential

F = np.float32
ZERO, ONE = F(0.0), F(1.0)
LOWEST = F(-3.0e38)


@device_function
def softmax(values: Array, at: int, out: Array, out_at: int, count: int) -> Any:
    """out[out_at:] = softmax of the ``count`` values[at:], which may be the same place. Returns the largest value m and
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
    """out = p (g - sum(p g) + shift): the gradient through a softmax whose values are p, and ``shift`` times p.

    ``count`` values, of p and g from ``at`` on, of out from ``out_at`` on.
    """
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
