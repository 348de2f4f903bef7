"""From visible anchors to the Gaussians to draw: opacities first, then everything else for what they leave."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine.atomics import fetch_add
from ...machine.compiled import Array, inlined, parallel_kernel
from ...machine.vectors import WIDTH, broadcast, lane_numbers, load, masked_load, store
from .activations import copy, exponential, sigmoid, tanh
from .layers import collect_inputs, head_of, list_anchors, run_head
from .packing import BATCH, COLOUR, COVARIANCE, OPACITY, SEMANTIC
from .softmax import soften

F = np.float32
ZERO = F(0.0)


@parallel_kernel
def decode_opacities(
    worker: int,
    workers: int,
    counter: Array,
    visible: Array,
    feature: Array,
    position: Array,
    centre: Array,
    weights: Array,
    heads: Any,
    sizes: Any,
    opacities: Array,
    counts: Array,
    scratch: Array,
    lists: Array,
) -> None:
    """``opacities`` [V * k] in (-1, 1) of the anchors ``visible`` [V], and how many of each batch are above 0."""
    mine, listed = scratch[worker], lists[worker]
    k, head = sizes.k, head_of(heads, OPACITY)
    while True:
        batch = fetch_add(counter)
        if batch >= counts.shape[0]:
            break
        start = batch * BATCH
        rows = min(visible.shape[0] - start, BATCH)
        for i in range(rows):
            listed[i] = start + i
        collect_inputs(listed, rows, visible, feature, position, centre, sizes, mine)
        run_head(head, rows, weights, sizes, mine)
        count = 0
        for i in range(rows):
            at = sizes.out_at + i * head.padded
            for c in range(0, head.padded, WIDTH):
                store(mine, at + c, tanh(load(mine, at + c)))
            for g in range(k):
                opacity = mine[at + g]
                opacities[(start + i) * k + g] = opacity
                if opacity > ZERO:
                    count += 1
        counts[batch] = count


@inlined
def write_shapes(
    listed: Array,
    count: int,
    first: int,
    head: Any,
    visible: Array,
    opacities: Array,
    position: Array,
    offset: Array,
    log_scale: Array,
    sizes: Any,
    mine: Array,
    kept: Array,
    means: Array,
    scales: Array,
    quats: Array,
    drawn_opacities: Array,
) -> None:
    """What the covariance decoder and the anchors tell of Gaussians ``first``, ``first`` + 1, ...: all but colour and
    labels."""
    k, n = sizes.k, first
    for i in range(count):
        v = listed[i]
        anchor, raw, active = visible[v], sizes.out_at + i * head.padded, sizes.active_at
        for c in range(0, head.padded, WIDTH):
            store(mine, active + c, sigmoid(load(mine, raw + c)))
        reach = active + head.padded
        six = lane_numbers() < broadcast(F(6.0))
        store(mine, reach, exponential(masked_load(log_scale, 6 * anchor, six)))
        for g in range(k):
            opacity = opacities[v * k + g]
            if opacity > ZERO:
                kept[n] = v * k + g
                drawn_opacities[n] = opacity
                for axis in range(3):
                    moved = offset[3 * (anchor * k + g) + axis] * mine[reach + axis]
                    means[3 * n + axis] = position[3 * anchor + axis] + moved
                    scales[3 * n + axis] = mine[reach + 3 + axis] * mine[active + 7 * g + axis]
                for part in range(4):
                    quats[4 * n + part] = mine[raw + 7 * g + 3 + part]
                n += 1


@inlined
def write_colours(
    listed: Array, count: int, first: int, head: Any, opacities: Array, sizes: Any, mine: Array, colours: Array
) -> None:
    k, n = sizes.k, first
    for i in range(count):
        at = sizes.out_at + i * head.padded
        for c in range(0, head.padded, WIDTH):
            store(mine, at + c, sigmoid(load(mine, at + c)))
        for g in range(k):
            if opacities[listed[i] * k + g] > ZERO:
                for channel in range(3):
                    colours[3 * n + channel] = mine[at + 3 * g + channel]
                n += 1


@inlined
def write_known_labels(
    listed: Array,
    count: int,
    first: int,
    k: int,
    visible: Array,
    opacities: Array,
    known: Array,
    channels: int,
    labels: Array,
) -> None:
    """Labels that were decoded before: rows of ``known`` [M * k, channels]."""
    n = first
    for i in range(count):
        v = listed[i]
        for g in range(k):
            if opacities[v * k + g] > ZERO:
                copy(known, (visible[v] * k + g) * channels, labels, n * channels, channels)
                n += 1


@inlined
def write_instances(
    listed: Array, count: int, first: int, head: Any, opacities: Array, sizes: Any, mine: Array, labels: Array
) -> None:
    k, n, slots, channels = sizes.k, first, sizes.slots, sizes.classes + sizes.slots
    soften(mine, sizes.out_at, head.padded, count, k, slots, sizes.tall_at, sizes.sums_at)
    for i in range(count):
        for g in range(k):
            if opacities[listed[i] * k + g] > ZERO:
                at = sizes.out_at + i * head.padded + g * slots
                copy(mine, at, labels, n * channels + sizes.classes, slots)
                n += 1


@inlined
def write_classes(
    listed: Array,
    count: int,
    first: int,
    head: Any,
    visible: Array,
    opacities: Array,
    channels: Array,
    sizes: Any,
    mine: Array,
    labels: Array,
) -> Any:
    """Class probabilities of the Gaussians to draw; returns the summed cross entropy of all k Gaussians of the anchors
    that have a channel in ``channels`` [M] (none does when that is empty)."""
    k, n, classes, stride = sizes.k, first, sizes.classes, sizes.classes + sizes.slots
    loss = 0.0
    if channels.shape[0] > 0:
        for i in range(count):
            wanted = channels[visible[listed[i]]]
            if wanted >= 0:
                for g in range(k):
                    loss -= mine[sizes.out_at + i * head.padded + g * classes + wanted]
    soften(mine, sizes.out_at, head.padded, count, k, classes, sizes.tall_at, sizes.sums_at)
    if channels.shape[0] > 0:
        rounded = (count + WIDTH - 1) // WIDTH * WIDTH
        for i in range(count):
            if channels[visible[listed[i]]] >= 0:
                product = 1.0  # of the k sums of exponentials: one logarithm will do
                for g in range(k):
                    loss += mine[sizes.sums_at + g * rounded + i]
                    product *= mine[sizes.sums_at + (k + g) * rounded + i]
                loss += math.log(product)
    for i in range(count):
        for g in range(k):
            if opacities[listed[i] * k + g] > ZERO:
                copy(mine, sizes.out_at + i * head.padded + g * classes, labels, n * stride, classes)
                n += 1
    return loss


@parallel_kernel
def decode_gaussians(
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
    known: Array,
    known_channels: int,
    kept: Array,
    means: Array,
    scales: Array,
    quats: Array,
    drawn_opacities: Array,
    colours: Array,
    labels: Array,
    losses: Array,
    scratch: Array,
    lists: Array,
) -> None:
    """All of the Gaussians with opacity above 0; batch b writes from Gaussian ``starts``[b] on.

    ``channels`` int64 [M] or empty: channel of the anchor's class for the cluster loss, -1 for none; ``losses``
    [batches] gets its sum. ``known`` [M * k, known_channels]: labels to copy instead of decoding; empty to decode them.
    """
    mine, listed = scratch[worker], lists[worker]
    k = sizes.k
    while True:
        batch = fetch_add(counter)
        if batch >= starts.shape[0]:
            break
        start, first = batch * BATCH, starts[batch]
        end = min(start + BATCH, visible.shape[0])
        drawn, everyone = list_anchors(start, end, k, opacities, visible, channels, listed)
        losses[batch] = 0.0
        if everyone == 0:
            continue
        collect_inputs(listed, everyone, visible, feature, position, centre, sizes, mine)
        for number in range(1, len(heads)):
            if number >= SEMANTIC and known.shape[0] > 0:
                write_known_labels(listed, drawn, first, k, visible, opacities, known, known_channels, labels)
                break
            head = head_of(heads, number)
            rows = everyone if number == SEMANTIC else drawn
            run_head(head, rows, weights, sizes, mine)
            if number == COVARIANCE:
                write_shapes(
                    listed,
                    drawn,
                    first,
                    head,
                    visible,
                    opacities,
                    position,
                    offset,
                    log_scale,
                    sizes,
                    mine,
                    kept,
                    means,
                    scales,
                    quats,
                    drawn_opacities,
                )
            elif number == COLOUR:
                write_colours(listed, drawn, first, head, opacities, sizes, mine, colours)
            elif number == SEMANTIC:
                losses[batch] = write_classes(
                    listed, everyone, first, head, visible, opacities, channels, sizes, mine, labels
                )
            else:
                write_instances(listed, drawn, first, head, opacities, sizes, mine, labels)
