"""Decodes visible anchors: first all opacities, then everything else for the Gaussians with an opacity above 0."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ...machine.vectors import WIDTH, fetch_add, load, store
from . import packing
from .activations import copy, sigmoid, softmax, tanh
from .layers import collect_inputs, collect_scales, head_of, list_batch, run_head, wanted_class
from .packing import BATCH, AnchorArrays, Batch, Decoding, Drawn, Labelling, Packed, Work

F = np.float32
ZERO = F(0.0)


@parallel_kernel
def decode_opacities(
    worker: int, workers: int, anchors: AnchorArrays, packed: Packed, opacities: Array, counts: Array, work: Work
) -> None:
    """Fill ``opacities`` [V * k], in (-1, 1), of visible anchors, and ``counts`` int64 [batches], how many exceed 0."""
    mine, listed = work.floats[worker], work.numbers[worker]
    sizes, head = packed.sizes, head_of(packed.heads, packing.OPACITY)
    k = sizes.k
    while True:
        batch = fetch_add(work.next_one)
        if batch >= counts.shape[0]:
            break
        start = batch * BATCH
        rows = min(anchors.visible.shape[0] - start, BATCH)
        for i in range(rows):
            listed[i] = start + i
        collect_inputs(listed, rows, anchors, sizes, mine)
        run_head(head, rows, packed, mine)
        above = 0
        for at in range(sizes.out_at, sizes.out_at + rows * head.padded, WIDTH):
            store(mine, at, tanh(load(mine, at)))
        for i in range(rows):
            for g in range(k):
                opacity = mine[sizes.out_at + i * head.padded + g]
                opacities[(start + i) * k + g] = opacity
                if opacity > ZERO:
                    above += 1
        counts[batch] = above


@device_function
def through_sigmoid(rows: int, head: Any, sizes: Any, mine: Array) -> None:
    """Apply the sigmoid, in place, to all outputs of a decoder in a worker's scratch ``mine``."""
    for at in range(sizes.out_at, sizes.out_at + rows * head.padded, WIDTH):
        store(mine, at, sigmoid(load(mine, at)))


@device_function
def write_shapes(
    batch: Batch, head: Any, anchors: AnchorArrays, opacities: Array, sizes: Any, mine: Array, drawn: Drawn
) -> None:
    """Write means, scales, rotations and opacities of the drawn Gaussians, from the covariance decoder's outputs."""
    k, scale = sizes.k, sizes.d_hidden_at  # room for a vector a row, of which six are the anchor's scales
    collect_scales(batch, anchors, mine, scale)
    for m in range(batch.gaussians):
        row, g, n = batch.owners[2 * m], batch.owners[2 * m + 1], batch.first + m
        v, at, own = batch.listed[row], sizes.out_at + row * head.padded + 7 * g, scale + row * WIDTH
        anchor = anchors.visible[v]
        drawn.opacities[n] = opacities[v * k + g]
        for axis in range(3):
            moved = anchors.offset[3 * (anchor * k + g) + axis] * mine[own + axis]
            drawn.means[3 * n + axis] = anchors.position[3 * anchor + axis] + moved
        for c in range(4):
            drawn.quats[4 * n + c] = mine[at + 3 + c]
    through_sigmoid(batch.drawing, head, sizes, mine)
    for m in range(batch.gaussians):
        row, n = batch.owners[2 * m], batch.first + m
        at = sizes.out_at + row * head.padded + 7 * batch.owners[2 * m + 1]
        for axis in range(3):
            drawn.scales[3 * n + axis] = mine[scale + row * WIDTH + 3 + axis] * mine[at + axis]


@device_function
def write_colours(batch: Batch, head: Any, sizes: Any, mine: Array, colours: Array) -> None:
    through_sigmoid(batch.drawing, head, sizes, mine)
    for m in range(batch.gaussians):
        at = sizes.out_at + batch.owners[2 * m] * head.padded + 3 * batch.owners[2 * m + 1]
        for c in range(3):
            colours[3 * (batch.first + m) + c] = mine[at + c]


@device_function
def write_known_labels(batch: Batch, k: int, visible: Array, labelling: Labelling, labels: Array) -> None:
    """Copy the labels ``known``, decoded earlier, to those of the drawn Gaussians of a batch."""
    channels = labelling.known_channels
    for m in range(batch.gaussians):
        anchor = visible[batch.listed[batch.owners[2 * m]]]
        source = (anchor * k + batch.owners[2 * m + 1]) * channels
        copy(labelling.known, source, labels, (batch.first + m) * channels, channels)


@device_function
def write_instances(batch: Batch, head: Any, sizes: Any, mine: Array, labels: Array) -> None:
    slots, channels = sizes.slots, sizes.classes + sizes.slots
    for m in range(batch.gaussians):
        at = sizes.out_at + batch.owners[2 * m] * head.padded + batch.owners[2 * m + 1] * slots
        softmax(mine, at, labels, (batch.first + m) * channels + sizes.classes, slots)


@device_function
def write_classes(
    batch: Batch, head: Any, visible: Array, labelling: Labelling, sizes: Any, mine: Array, labels: Array
) -> Any:
    """Write the drawn Gaussians' class probabilities. Return the cross entropy (of L_cluster), summed over all k
    Gaussians of each anchor whose class is known."""
    k, classes, channels = sizes.k, sizes.classes, sizes.classes + sizes.slots
    loss, m = 0.0, 0
    for row in range(batch.rows):
        wanted = wanted_class(batch.listed[row], visible, labelling)
        for g in range(k):
            at = sizes.out_at + row * head.padded + g * classes
            logit = mine[at + max(wanted, 0)]  # before a softmax in place replaces it
            drawn = m < batch.gaussians and batch.owners[2 * m] == row and batch.owners[2 * m + 1] == g
            if drawn:
                top, total = softmax(mine, at, labels, (batch.first + m) * channels, classes)
                m += 1
            elif wanted >= 0:
                top, total = softmax(mine, at, mine, at, classes)
            else:
                continue
            if wanted >= 0:
                loss += top + math.log(total) - logit
    return loss


@parallel_kernel
def decode_gaussians(worker: int, workers: int, given: Decoding, drawn: Drawn, work: Work) -> None:
    """Decode all Gaussians with an opacity above 0 into ``drawn``, and L_cluster's sums into ``batches.losses``."""
    anchors, packed, labelling, batches = given
    mine, numbers = work.floats[worker], work.numbers[worker]
    sizes, heads, visible = packed.sizes, packed.heads, anchors.visible
    decoded = packing.INSTANCE if labelling.known.shape[0] == 0 else packing.COLOUR
    while True:
        number = fetch_add(work.next_one)
        if number >= batches.starts.shape[0]:
            break
        batch = list_batch(number, sizes.k, visible, batches, labelling, numbers)
        batches.losses[number] = 0.0
        if batch.rows == 0:
            continue
        collect_inputs(batch.listed, batch.rows, anchors, sizes, mine)
        for kind in range(packing.COVARIANCE, decoded + 1):
            head = head_of(heads, kind)
            run_head(head, batch.rows if kind == packing.SEMANTIC else batch.drawing, packed, mine)
            if kind == packing.COVARIANCE:
                write_shapes(batch, head, anchors, batches.opacities, sizes, mine, drawn)
            elif kind == packing.COLOUR:
                write_colours(batch, head, sizes, mine, drawn.colours)
            elif kind == packing.SEMANTIC:
                batches.losses[number] = write_classes(batch, head, visible, labelling, sizes, mine, drawn.labels)
            else:
                write_instances(batch, head, sizes, mine, drawn.labels)
        if decoded == packing.COLOUR:
            write_known_labels(batch, sizes.k, visible, labelling, drawn.labels)
