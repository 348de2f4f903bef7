"""What both passes do with a batch of anchors: collect their inputs, run a decoder's two layers, and go back through
them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined
from ...machine.vectors import WIDTH, broadcast, load, maximum, select, store
from ..decoders import HIDDEN
from .activations import copy
from .blocks import add_product
from .packing import ROUND_ROWS, Head

F = np.float32
ZERO = F(0.0)
WIDE, STEP, START = np.int64(HIDDEN), np.int64(1), np.int64(0)
"""For the arguments of ``add_product``: Numba would compile it anew for each plain number written there."""
CLOSEST = F(1e-6)
"""Metres: an anchor at the camera's centre is seen from a distance of at least this."""


@inlined
def head_of(heads: Array, number: int) -> Any:
    """Row ``number`` of heads [5, 9]."""
    row = heads[number]
    return Head(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8])


@inlined
def rounded_rows(rows: int) -> int:
    return (rows + ROUND_ROWS - 1) // ROUND_ROWS * ROUND_ROWS


@inlined
def fill(values: Array, at: int, count: int, value: Any) -> None:
    for i in range(at, at + count):
        values[i] = value


@device_function
def list_anchors(start: int, end: int, k: int, opacities: Array, visible: Array, channels: Array, listed: Array) -> Any:
    """Lists the places in ``visible`` [V] from ``start`` to ``end`` that have work beyond their opacity.

    First the anchors with a Gaussian to draw, then those that the cluster loss alone asks for. Returns how many of the
    former, and of both together.
    """
    drawn = 0
    for v in range(start, end):
        shown = 0
        for g in range(k):
            if opacities[v * k + g] > ZERO:
                shown += 1
        if shown > 0:
            listed[drawn] = v
            drawn += 1
    everyone = drawn
    if channels.shape[0] > 0:
        for v in range(start, end):
            if channels[visible[v]] >= 0:
                shown = 0
                for g in range(k):
                    if opacities[v * k + g] > ZERO:
                        shown += 1
                if shown == 0:
                    listed[everyone] = v
                    everyone += 1
    return drawn, everyone


@device_function
def collect_inputs(
    listed: Array, count: int, visible: Array, feature: Array, position: Array, centre: Array, sizes: Any, mine: Array
) -> None:
    """Rows of inputs (see ``Sizes``) of ``count`` listed anchors to the start of a worker's scratch."""
    seen = sizes.features
    for i in range(count):
        anchor = visible[listed[i]]
        at, source = i * sizes.inputs, anchor * sizes.features
        copy(feature, source, mine, at, seen)
        x, y, z = (
            position[3 * anchor] - centre[0],
            position[3 * anchor + 1] - centre[1],
            position[3 * anchor + 2] - centre[2],
        )
        distance = max(F(math.sqrt(x * x + y * y + z * z)), CLOSEST)
        mine[at + seen], mine[at + seen + 1], mine[at + seen + 2] = x / distance, y / distance, z / distance
        for c in range(seen + 3, sizes.inputs):
            mine[at + c] = ZERO
        if sizes.distance > 0:
            mine[at + seen + 3] = distance
    fill(mine, count * sizes.inputs, (rounded_rows(count) - count) * sizes.inputs, ZERO)


@device_function
def run_first_layer(head: Any, rows: int, weights: Array, sizes: Any, mine: Array) -> None:
    """The hidden layer of ``rows`` anchors after ReLU."""
    at = sizes.hidden_at
    for i in range(rounded_rows(rows)):
        for c in range(0, HIDDEN, WIDTH):
            store(mine, at + i * HIDDEN + c, load(weights, head.first_bias + c))
    add_product(mine, at, WIDE, mine, START, sizes.inputs, STEP, weights, head.first, WIDE, rows, WIDE, head.inputs)
    for c in range(at, at + rows * HIDDEN, WIDTH):
        store(mine, c, maximum(load(mine, c), broadcast(ZERO)))


@device_function
def run_head(head: Any, rows: int, weights: Array, sizes: Any, mine: Array) -> None:
    """Hidden layer and outputs [rows, padded] of one decoder."""
    run_first_layer(head, rows, weights, sizes, mine)
    at = sizes.out_at
    for i in range(rounded_rows(rows)):
        for c in range(0, head.padded, WIDTH):
            store(mine, at + i * head.padded + c, load(weights, head.last_bias + c))
    add_product(
        mine,
        at,
        head.padded,
        mine,
        sizes.hidden_at,
        WIDE,
        STEP,
        weights,
        head.last,
        head.padded,
        rows,
        head.padded,
        WIDE,
    )


@inlined
def add_columns(out: Array, out_at: int, values: Array, at: int, stride: int, rows: int, columns: int) -> None:
    """out[c] += the sum over rows of values[row, c], in ascending order."""
    for c in range(0, columns, WIDTH):
        total = load(out, out_at + c)
        for i in range(rows):
            total = total + load(values, at + i * stride + c)
        store(out, out_at + c, total)


@device_function
def run_head_back(head: Any, rows: int, weights: Array, sizes: Any, mine: Array, gradient: Array) -> None:
    """From the gradient of the outputs in their place, and the hidden layer in its, to the gradients of the weights
    (added to ``gradient``) and of the features (added to scratch)."""
    hidden, d_hidden, out, padded = sizes.hidden_at, sizes.d_hidden_at, sizes.out_at, head.padded
    add_product(gradient, head.last, padded, mine, hidden, STEP, WIDE, mine, out, padded, WIDE, padded, rows)
    add_columns(gradient, head.last_bias, mine, out, padded, rows, padded)

    fill(mine, d_hidden, rounded_rows(rows) * HIDDEN, ZERO)
    add_product(mine, d_hidden, WIDE, mine, out, padded, STEP, weights, head.last_back, WIDE, rows, WIDE, head.outputs)
    for c in range(0, rows * HIDDEN, WIDTH):
        passed = load(mine, hidden + c) > broadcast(ZERO)
        store(mine, d_hidden + c, select(passed, load(mine, d_hidden + c), broadcast(ZERO)))

    add_product(
        gradient, head.first, WIDE, mine, START, STEP, sizes.inputs, mine, d_hidden, WIDE, head.inputs, WIDE, rows
    )
    add_columns(gradient, head.first_bias, mine, d_hidden, HIDDEN, rows, HIDDEN)
    features = sizes.padded_features
    add_product(
        mine,
        sizes.d_inputs_at,
        features,
        mine,
        d_hidden,
        WIDE,
        STEP,
        weights,
        head.first_back,
        features,
        rows,
        features,
        WIDE,
    )
