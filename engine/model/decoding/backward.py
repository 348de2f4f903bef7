"""Takes the gradients of the drawn Gaussians and of the cluster loss back to anchors and decoders. Hidden layers are
recomputed, which is cheaper than keeping them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ...machine.vectors import WIDTH, fetch_add
from . import layers, packing
from .activations import softmax, softmax_backward
from .packing import AnchorArrays, Batch, Decoding, Gradients, Labelling, Packed, Work

F = np.float32
ZERO, ONE = F(0.0), F(1.0)


@device_function
def opacities_backward(batch: Batch, head: Any, sizes: Any, mine: Array, gradients: Gradients) -> None:
    """Write the gradients of the opacity decoder's outputs, before tanh, to a worker's scratch ``mine``."""
    for m in range(batch.gaussians):
        n = batch.first + m
        opacity = gradients.drawn.opacities[n]
        at = sizes.out_at + batch.owners[2 * m] * head.padded + batch.owners[2 * m + 1]
        mine[at] = gradients.by.opacities[n] * (ONE - opacity * opacity)


@device_function
def shapes_backward(
    batch: Batch, head: Any, anchors: AnchorArrays, sizes: Any, mine: Array, gradients: Gradients
) -> None:
    """Write the gradients of the covariance decoder's outputs to a worker's scratch ``mine``, and those of the anchors'
    offsets and log scales to ``gradients``."""
    by, d_log_scale = gradients.by, gradients.log_scale
    room = sizes.d_hidden_at  # for a vector a row, of which six are the anchor's scales
    layers.collect_scales(batch, anchors, mine, room)
    for m in range(batch.gaussians):
        row, g, n = batch.owners[2 * m], batch.owners[2 * m + 1], batch.first + m
        anchor, at = anchors.visible[batch.listed[row]], sizes.out_at + row * head.padded + 7 * g
        own = room + row * WIDTH
        for axis in range(3):
            index, stretch = 3 * (anchor * sizes.k + g) + axis, 6 * anchor + axis
            d_offset = by.means[3 * n + axis] * mine[own + axis]
            gradients.offset[index] = d_offset
            d_log_scale[stretch] += d_offset * anchors.offset[index]
            scale = gradients.drawn.scales[3 * n + axis]
            slope = by.scales[3 * n + axis] * scale
            d_log_scale[stretch + 3] += slope
            mine[at + axis] = slope * (ONE - scale / mine[own + 3 + axis])
        for c in range(4):
            mine[at + 3 + c] = by.quats[4 * n + c]


@device_function
def colours_backward(batch: Batch, head: Any, sizes: Any, mine: Array, gradients: Gradients) -> None:
    """Write the gradients of the colour decoder's outputs, before the sigmoid, to a worker's scratch ``mine``."""
    for m in range(batch.gaussians):
        at = sizes.out_at + batch.owners[2 * m] * head.padded + 3 * batch.owners[2 * m + 1]
        for c in range(3):
            index = 3 * (batch.first + m) + c
            colour = gradients.drawn.colours[index]
            mine[at + c] = gradients.by.colours[index] * colour * (ONE - colour)


@device_function
def instances_backward(batch: Batch, head: Any, sizes: Any, mine: Array, gradients: Gradients) -> None:
    """Write the gradients of the instance decoder's outputs, before the softmax, to a worker's scratch ``mine``."""
    slots, channels = sizes.slots, sizes.classes + sizes.slots
    for m in range(batch.gaussians):
        at = sizes.out_at + batch.owners[2 * m] * head.padded + batch.owners[2 * m + 1] * slots
        label = (batch.first + m) * channels + sizes.classes
        softmax_backward(gradients.drawn.labels, label, gradients.by.labels, ZERO, mine, at, slots)


@device_function
def classes_backward(
    batch: Batch, head: Any, visible: Array, labelling: Labelling, sizes: Any, mine: Array, gradients: Gradients
) -> None:
    """Replace the semantic decoder's outputs, in a worker's scratch ``mine``, by their gradients."""
    k, classes, channels = sizes.k, sizes.classes, sizes.classes + sizes.slots
    m = 0
    for row in range(batch.rows):
        wanted = layers.wanted_class(batch.listed[row], visible, labelling)
        weight = F(gradients.by_loss) if wanted >= 0 else ZERO
        for g in range(k):
            at = sizes.out_at + row * head.padded + g * classes
            if m < batch.gaussians and batch.owners[2 * m] == row and batch.owners[2 * m + 1] == g:
                label = (batch.first + m) * channels
                softmax_backward(gradients.drawn.labels, label, gradients.by.labels, weight, mine, at, classes)
                m += 1
            elif wanted >= 0:
                softmax(mine, at, mine, at, classes)
                for c in range(at, at + classes):
                    mine[c] *= weight
            else:
                layers.fill(mine, at, classes, ZERO)
            if wanted >= 0:
                mine[at + wanted] -= weight


@device_function
def batch_backward(
    batch: Batch,
    anchors: AnchorArrays,
    packed: Packed,
    labelling: Labelling,
    mine: Array,
    d_weights: Array,
    gradients: Gradients,
) -> None:
    """Compute the gradients of one batch of anchors; add those of the weights to ``d_weights``."""
    sizes = packed.sizes
    layers.collect_inputs(batch.listed, batch.rows, anchors, sizes, mine)
    layers.fill(mine, sizes.d_inputs_at, layers.rounded_rows(batch.rows) * sizes.padded_features, ZERO)
    # labels decoded before have no gradient
    last = packing.INSTANCE if labelling.known.shape[0] == 0 else packing.COLOUR
    for kind in range(packing.OPACITY, last + 1):
        head = layers.head_of(packed.heads, kind)
        rows = batch.rows if kind == packing.SEMANTIC else batch.drawing
        if kind == packing.SEMANTIC:
            layers.run_head(head, rows, packed, mine)
            classes_backward(batch, head, anchors.visible, labelling, sizes, mine, gradients)
        else:
            layers.run_first_layer(head, rows, packed, mine)
            layers.fill(mine, sizes.out_at, layers.rounded_rows(rows) * head.padded, ZERO)
            if kind == packing.OPACITY:
                opacities_backward(batch, head, sizes, mine, gradients)
            elif kind == packing.COVARIANCE:
                shapes_backward(batch, head, anchors, sizes, mine, gradients)
            elif kind == packing.COLOUR:
                colours_backward(batch, head, sizes, mine, gradients)
            else:
                instances_backward(batch, head, sizes, mine, gradients)
        layers.run_head_backward(head, rows, packed, mine, d_weights)
    for i in range(batch.rows):
        to, source = anchors.visible[batch.listed[i]] * sizes.features, sizes.d_inputs_at + i * sizes.padded_features
        for c in range(sizes.features):
            gradients.feature[to + c] = mine[source + c]


@parallel_kernel
def decode_backward(worker: int, workers: int, given: Decoding, gradients: Gradients, work: Work) -> None:
    """Compute the gradients of anchors and packed weights. Weights are summed in a fixed number of chunks, so that
    their sum does not depend on which thread is faster."""
    anchors, packed, labelling, batches = given
    mine, numbers = work.floats[worker], work.numbers[worker]
    count, chunks = batches.starts.shape[0], gradients.weights.shape[0]
    while True:
        chunk = fetch_add(work.next_one)
        if chunk >= chunks:
            break
        d_weights = gradients.weights[chunk]
        layers.fill(d_weights, 0, d_weights.shape[0], ZERO)
        for number in range(count * chunk // chunks, count * (chunk + 1) // chunks):
            batch = layers.list_batch(number, packed.sizes.k, anchors.visible, batches, labelling, numbers)
            if batch.rows > 0:
                batch_backward(batch, anchors, packed, labelling, mine, d_weights, gradients)
