"""From the gradients of the drawn Gaussians, and of the cluster loss, to those of anchors and decoders.

Hidden layers are decoded again: that is cheaper than keeping them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...machine.atomics import fetch_add
from ...machine.compiled import Array, inlined, parallel_kernel
from ...machine.vectors import broadcast, lane_numbers, masked_load, store
from .activations import exponential
from .layers import collect_inputs, fill, head_of, list_anchors, rounded_rows, run_first_layer, run_head, run_head_back
from .packing import BATCH, COLOUR, COVARIANCE, OPACITY, SEMANTIC
from .softmax import soften, soften_back

F = np.float32
ZERO, ONE = F(0.0), F(1.0)


@parallel_kernel
def clear(worker: int, workers: int, values: Array) -> None:
    """This worker's share of the values to 0."""
    count = values.shape[0]
    for i in range(count * worker // workers, count * (worker + 1) // workers):
        values[i] = ZERO


@inlined
def opacities_back(
    listed: Array, count: int, first: int, head: Any, opacities: Array, d_opacities: Array, sizes: Any, mine: Array
) -> None:
    """Through tanh."""
    k, n = sizes.k, first
    for i in range(count):
        for g in range(k):
            opacity = opacities[listed[i] * k + g]
            if opacity > ZERO:
                mine[sizes.out_at + i * head.padded + g] = d_opacities[n] * (ONE - opacity * opacity)
                n += 1


@inlined
def shapes_back(
    listed: Array,
    count: int,
    first: int,
    head: Any,
    visible: Array,
    opacities: Array,
    offset: Array,
    log_scale: Array,
    scales: Array,
    d_means: Array,
    d_scales: Array,
    d_quats: Array,
    sizes: Any,
    mine: Array,
    d_offset: Array,
    d_log_scale: Array,
) -> None:
    """Outputs of the covariance decoder, offsets and log scales."""
    k, n = sizes.k, first
    reach = sizes.active_at
    for i in range(count):
        v = listed[i]
        anchor, at = visible[v], sizes.out_at + i * head.padded
        six = lane_numbers() < broadcast(F(6.0))
        store(mine, reach, exponential(masked_load(log_scale, 6 * anchor, six)))
        for g in range(k):
            if opacities[v * k + g] > ZERO:
                for axis in range(3):
                    place = 3 * (anchor * k + g) + axis
                    stretched = d_means[3 * n + axis] * mine[reach + axis]
                    d_offset[place] = stretched
                    d_log_scale[6 * anchor + axis] += stretched * offset[place]
                    scale = scales[3 * n + axis]
                    slope = d_scales[3 * n + axis] * scale
                    d_log_scale[6 * anchor + 3 + axis] += slope
                    mine[at + 7 * g + axis] = slope * (ONE - scale / mine[reach + 3 + axis])
                for part in range(4):
                    mine[at + 7 * g + 3 + part] = d_quats[4 * n + part]
                n += 1


@inlined
def colours_back(
    listed: Array,
    count: int,
    first: int,
    head: Any,
    opacities: Array,
    colours: Array,
    d_colours: Array,
    sizes: Any,
    mine: Array,
) -> None:
    """Through the sigmoid."""
    k, n = sizes.k, first
    for i in range(count):
        for g in range(k):
            if opacities[listed[i] * k + g] > ZERO:
                for channel in range(3):
                    colour = colours[3 * n + channel]
                    slope = d_colours[3 * n + channel] * colour * (ONE - colour)
                    mine[sizes.out_at + i * head.padded + 3 * g + channel] = slope
                n += 1


@inlined
def instances_back(
    listed: Array,
    count: int,
    first: int,
    head: Any,
    opacities: Array,
    labels: Array,
    d_labels: Array,
    sizes: Any,
    mine: Array,
) -> None:
    """Through the softmax, whose values are the labels."""
    k, n, slots, stride = sizes.k, first, sizes.slots, sizes.classes + sizes.slots
    for i in range(count):
        for g in range(k):
            if opacities[listed[i] * k + g] > ZERO:
                at, label = sizes.out_at + i * head.padded + g * slots, n * stride + sizes.classes
                soften_back(labels, label, d_labels, label, ZERO, mine, at, slots)
                n += 1


@inlined
def classes_back(
    listed: Array,
    count: int,
    first: int,
    head: Any,
    visible: Array,
    opacities: Array,
    channels: Array,
    d_loss: Any,
    labels: Array,
    d_labels: Array,
    sizes: Any,
    mine: Array,
) -> None:
    """Logits in their place become their gradients. ``d_loss`` is that of one Gaussian's cross entropy."""
    k, n, classes, stride = sizes.k, first, sizes.classes, sizes.classes + sizes.slots
    soften(mine, sizes.out_at, head.padded, count, k, classes, sizes.tall_at, sizes.sums_at)
    for i in range(count):
        v = listed[i]
        wanted = channels[visible[v]] if channels.shape[0] > 0 else -1
        weight = d_loss if wanted >= 0 else ZERO
        for g in range(k):
            at = sizes.out_at + i * head.padded + g * classes
            is_drawn = opacities[v * k + g] > ZERO
            if is_drawn:
                soften_back(labels, n * stride, d_labels, n * stride, weight, mine, at, classes)
                n += 1
            elif wanted >= 0:
                for c in range(at, at + classes):
                    mine[c] *= weight
            else:
                fill(mine, at, classes, ZERO)
            if wanted >= 0:
                mine[at + wanted] -= weight


@parallel_kernel
def decode_back(
    worker: int,
    workers: int,
    counter: Array,
    visible: Array,
    feature: Array,
    position: Array,
    offset: Array,
    log_scale: Array,
    centre: Array,
    weights: Array,
    heads: Any,
    sizes: Any,
    opacities: Array,
    starts: Array,
    channels: Array,
    scales: Array,
    colours: Array,
    labels: Array,
    d_means: Array,
    d_scales: Array,
    d_quats: Array,
    d_opacities: Array,
    d_colours: Array,
    d_labels: Array,
    d_loss: Any,
    d_feature: Array,
    d_offset: Array,
    d_log_scale: Array,
    gradients: Array,
    scratch: Array,
    lists: Array,
) -> None:
    """Gradients of the anchors (dense, zero before) and of the packed weights, one row of ``gradients`` for each of a
    fixed number of parts, which are runs of batches: their sum then does not depend on who did what."""
    mine, listed = scratch[worker], lists[worker]
    k, batches, parts = sizes.k, starts.shape[0], gradients.shape[0]
    while True:
        part = fetch_add(counter)
        if part >= parts:
            break
        gradient = gradients[part]
        fill(gradient, 0, gradient.shape[0], ZERO)
        for batch in range(batches * part // parts, batches * (part + 1) // parts):
            start, first = batch * BATCH, starts[batch]
            end = min(start + BATCH, visible.shape[0])
            drawn, everyone = list_anchors(start, end, k, opacities, visible, channels, listed)
            if everyone == 0:
                continue
            collect_inputs(listed, everyone, visible, feature, position, centre, sizes, mine)
            fill(mine, sizes.d_inputs_at, rounded_rows(everyone) * sizes.padded_features, ZERO)

            for number in range(len(heads)):
                head = head_of(heads, number)
                rows = everyone if number == SEMANTIC else drawn
                if number == SEMANTIC:
                    run_head(head, rows, weights, sizes, mine)
                else:
                    run_first_layer(head, rows, weights, sizes, mine)
                    fill(mine, sizes.out_at, rounded_rows(rows) * head.padded, ZERO)
                if number == OPACITY:
                    opacities_back(listed, rows, first, head, opacities, d_opacities, sizes, mine)
                elif number == COVARIANCE:
                    shapes_back(
                        listed,
                        rows,
                        first,
                        head,
                        visible,
                        opacities,
                        offset,
                        log_scale,
                        scales,
                        d_means,
                        d_scales,
                        d_quats,
                        sizes,
                        mine,
                        d_offset,
                        d_log_scale,
                    )
                elif number == COLOUR:
                    colours_back(listed, rows, first, head, opacities, colours, d_colours, sizes, mine)
                elif number == SEMANTIC:
                    classes_back(
                        listed,
                        rows,
                        first,
                        head,
                        visible,
                        opacities,
                        channels,
                        d_loss,
                        labels,
                        d_labels,
                        sizes,
                        mine,
                    )
                else:
                    instances_back(listed, rows, first, head, opacities, labels, d_labels, sizes, mine)
                run_head_back(head, rows, weights, sizes, mine, gradient)
            for i in range(everyone):
                to, source = visible[listed[i]] * sizes.features, sizes.d_inputs_at + i * sizes.padded_features
                for c in range(sizes.features):
                    d_feature[to + c] = mine[source + c]
