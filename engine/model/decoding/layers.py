"""What both passes share: listing a batch of anchors, copying their inputs, and running a decoder's two layers forward
and backward."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, inlined
from ...machine.matrix_product import Factors, Rows, add_product
from ...machine.vectors import WIDTH, broadcast, lane_numbers, load, masked_load, maximum, select, store
from ..decoders import HIDDEN
from .activations import copy, exponential
from .packing import BATCH, ROUND_ROWS, AnchorArrays, Batch, Batches, Head, Labelling, Packed

F = np.float32
ZERO = F(0.0)
HIDDEN_64: Any = np.int64(HIDDEN)
ONE_64: Any = np.int64(1)
ZERO_64: Any = np.int64(0)
"""Typed argument of ``add_product``, as Numba would compile it again for every literal."""
CLOSEST = F(1e-6)
"""Minimum distance in metres between an anchor and the camera's centre."""


@inlined
def head_of(heads: Array, number: int) -> Any:
    """Return row ``number`` of ``heads`` [5, 9] as a ``Head``."""
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
def wanted_class(row: int, visible: Array, labelling: Labelling) -> int:
    """Return the channel of an anchor's class, for the cluster loss, or -1. ``row`` is its index in ``visible``."""
    return labelling.channels[visible[row]] if labelling.channels.shape[0] > 0 else -1


@device_function
def list_anchors(
    number: int, k: int, visible: Array, opacities: Array, labelling: Labelling, listed: Array, owners: Array
) -> Any:
    """List the anchors of batch ``number`` that draw a Gaussian or have a cluster loss, in ``listed``, and for each
    Gaussian its anchor and number in ``owners``. Return ``rows``, ``drawing`` and ``gaussians`` of ``Batch``."""
    start = number * BATCH
    end = min(start + BATCH, visible.shape[0])
    drawing, gaussians = 0, 0
    for v in range(start, end):
        before = gaussians
        for g in range(k):
            if opacities[v * k + g] > ZERO:
                owners[2 * gaussians] = drawing
                owners[2 * gaussians + 1] = g
                gaussians += 1
        if gaussians > before:
            listed[drawing] = v
            drawing += 1
    rows, index = drawing, 0
    for v in range(start, end):
        if index < drawing and listed[index] == v:
            index += 1
        elif wanted_class(v, visible, labelling) >= 0:
            listed[rows] = v
            rows += 1
    return rows, drawing, gaussians


@inlined
def list_batch(number: int, k: int, visible: Array, batches: Batches, labelling: Labelling, numbers: Array) -> Any:
    """Return batch ``number`` of ``visible`` anchors; its lists are kept in ``numbers`` int64 [BATCH * (1 + 2 k)]."""
    listed, owners = numbers[:BATCH], numbers[BATCH:]
    rows, drawing, gaussians = list_anchors(number, k, visible, batches.opacities, labelling, listed, owners)
    return Batch(listed, rows, drawing, owners, batches.starts[number], gaussians)


@device_function
def collect_inputs(listed: Array, rows: int, anchors: AnchorArrays, sizes: Any, mine: Array) -> None:
    """Copy feature, direction and distance of the ``listed`` anchors to the start of a worker's scratch ``mine``."""
    seen, position, centre = sizes.features, anchors.position, anchors.centre
    for i in range(rows):
        anchor = anchors.visible[listed[i]]
        at, source = i * sizes.inputs, anchor * sizes.features
        copy(anchors.feature, source, mine, at, seen)
        x = position[3 * anchor] - centre[0]
        y = position[3 * anchor + 1] - centre[1]
        z = position[3 * anchor + 2] - centre[2]
        distance = max(F(math.sqrt(x * x + y * y + z * z)), CLOSEST)
        mine[at + seen], mine[at + seen + 1], mine[at + seen + 2] = x / distance, y / distance, z / distance
        fill(mine, at + seen + 3, sizes.inputs - seen - 3, ZERO)
        if sizes.distance > 0:
            mine[at + seen + 3] = distance
    fill(mine, rows * sizes.inputs, (rounded_rows(rows) - rows) * sizes.inputs, ZERO)


@device_function
def start_with(bias: int, columns: int, weights: Array, at: int, rows: int, mine: Array) -> None:
    """Set each of the rows at mine[at:] to the bias, the ``columns`` values weights[bias:]."""
    for i in range(rounded_rows(rows)):
        for c in range(0, columns, WIDTH):
            store(mine, at + i * columns + c, load(weights, bias + c))


@device_function
def run_first_layer(head: Any, rows: int, packed: Packed, mine: Array) -> None:
    """Compute the hidden layer of a decoder, after ReLU, for ``rows`` anchors in a worker's scratch ``mine``."""
    sizes, weights = packed.sizes, packed.weights
    at = sizes.hidden_at
    start_with(head.first_bias, HIDDEN, weights, at, rows, mine)
    inputs = Factors(mine, ZERO_64, sizes.inputs, ONE_64)
    add_product(Rows(mine, at, HIDDEN_64), inputs, Rows(weights, head.first, HIDDEN_64), rows, HIDDEN_64, head.inputs)
    for c in range(at, at + rows * HIDDEN, WIDTH):
        store(mine, c, maximum(load(mine, c), broadcast(ZERO)))


@device_function
def run_head(head: Any, rows: int, packed: Packed, mine: Array) -> None:
    """Compute a decoder's hidden layer and its outputs [rows, padded], in a worker's scratch ``mine``."""
    run_first_layer(head, rows, packed, mine)
    sizes, weights, padded = packed.sizes, packed.weights, head.padded
    start_with(head.last_bias, padded, weights, sizes.out_at, rows, mine)
    hidden = Factors(mine, sizes.hidden_at, HIDDEN_64, ONE_64)
    add_product(Rows(mine, sizes.out_at, padded), hidden, Rows(weights, head.last, padded), rows, padded, HIDDEN_64)


@device_function
def add_columns(out: Array, out_at: int, values: Array, at: int, rows: int, columns: int) -> None:
    """Add each row of values[at:], taken as [rows, columns], to out[out_at:], in ascending order."""
    for c in range(0, columns, WIDTH):
        total = load(out, out_at + c)
        for i in range(rows):
            total = total + load(values, at + i * columns + c)
        store(out, out_at + c, total)


@device_function
def run_head_backward(head: Any, rows: int, packed: Packed, mine: Array, gradient: Array) -> None:
    """Take the gradient of a decoder's outputs, in the scratch ``mine``, through its two layers: add the weights'
    gradients to ``gradient``, and the features' to the scratch."""
    sizes, weights, padded = packed.sizes, packed.weights, head.padded
    hidden, d_hidden, out, features = sizes.hidden_at, sizes.d_hidden_at, sizes.out_at, sizes.padded_features
    of_out, of_hidden = Rows(mine, out, padded), Rows(mine, d_hidden, HIDDEN_64)

    transposed = Factors(mine, hidden, ONE_64, HIDDEN_64)
    add_product(Rows(gradient, head.last, padded), transposed, of_out, HIDDEN_64, padded, rows)
    add_columns(gradient, head.last_bias, mine, out, rows, padded)

    fill(mine, d_hidden, rounded_rows(rows) * HIDDEN, ZERO)
    by_out = Factors(mine, out, padded, ONE_64)
    add_product(of_hidden, by_out, Rows(weights, head.last_back, HIDDEN_64), rows, HIDDEN_64, head.outputs)
    for c in range(0, rows * HIDDEN, WIDTH):
        passed = load(mine, hidden + c) > broadcast(ZERO)
        store(mine, d_hidden + c, select(passed, load(mine, d_hidden + c), broadcast(ZERO)))

    transposed = Factors(mine, ZERO_64, ONE_64, sizes.inputs)
    add_product(Rows(gradient, head.first, HIDDEN_64), transposed, of_hidden, head.inputs, HIDDEN_64, rows)
    add_columns(gradient, head.first_bias, mine, d_hidden, rows, HIDDEN_64)
    by_hidden = Factors(mine, d_hidden, HIDDEN_64, ONE_64)
    d_inputs = Rows(mine, sizes.d_inputs_at, features)
    add_product(d_inputs, by_hidden, Rows(weights, head.first_back, features), rows, features, HIDDEN_64)


@device_function
def collect_scales(batch: Batch, anchors: AnchorArrays, mine: Array, room: int) -> None:
    """Copy the six log scales of each anchor that draws, as a vector each, to mine[room:]."""
    for row in range(batch.drawing):
        six = lane_numbers() < broadcast(F(6.0))
        log_scale = masked_load(anchors.log_scale, 6 * anchors.visible[batch.listed[row]], six)
        store(mine, room + row * WIDTH, exponential(log_scale))
