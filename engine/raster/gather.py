"""Gradients of a Gaussian's tiles, added in order, and carried back to its 3D parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..machine.compiled import Array, parallel_kernel, part
from .chain_to_scene import chain_to_scene, enter, leave
from .lanes import LANES
from .portions import portion_count, take_portion
from .records import (
    D_BLUE,
    D_GREEN,
    D_RED,
    GRADIENT,
    GRADIENT_WIDTH,
    OPACITY,
    G,
    padded_channels,
)

F = np.float32


@part
def clear(
    i: int,
    d_means: Array,
    d_scales: Array,
    d_quats: Array,
    d_opacities: Array,
    d_colours: Array,
    d_means2d: Array,
) -> None:
    d_opacities[i] = F(0.0)
    for c in range(2):
        d_means2d[i, c] = F(0.0)
    for c in range(3):
        d_means[i, c] = F(0.0)
        d_scales[i, c] = F(0.0)
        d_colours[i, c] = F(0.0)
    for c in range(4):
        d_quats[i, c] = F(0.0)


@part
def gather_geometry(
    worker: int,
    first: int,
    end: int,
    slots: Array,
    touched: Array,
    slot_gradients: Array,
    records: Array,
    means: Array,
    scales: Array,
    quats: Array,
    camera: Array,
    sums: Array,
    blocks: Array,
    d_means: Array,
    d_scales: Array,
    d_quats: Array,
    d_opacities: Array,
    d_colours: Array,
    d_means2d: Array,
) -> None:
    """The gradients of the Gaussians from ``first`` to before ``end`` but for their labels, zeros included; ``sums``
    float64 [workers, TILE] and ``blocks`` [workers, CHAIN_BLOCK] are room to work in."""
    total, block = sums[worker], blocks[worker]
    lanes = 0
    for i in range(first, end):
        hit = False
        for c in range(GRADIENT):
            total[c] = 0.0
        for slot in range(slots[i], slots[i + 1]):
            if touched[slot] == 0:
                continue
            for c in range(GRADIENT):
                total[c] += np.float64(slot_gradients[slot * GRADIENT_WIDTH + c])
            hit = True
        if not hit:
            clear(i, d_means, d_scales, d_quats, d_opacities, d_colours, d_means2d)
            continue
        d_opacities[i] = total[G] / np.float64(records[i, OPACITY])
        d_colours[i, 0] = total[D_RED]
        d_colours[i, 1] = total[D_GREEN]
        d_colours[i, 2] = total[D_BLUE]
        enter(i, lanes, total, records, means, scales, quats, block)
        lanes += 1
        if lanes == LANES:
            chain_to_scene(camera, block)
            leave(lanes, block, d_means, d_scales, d_quats, d_means2d)
            lanes = 0
    if lanes > 0:
        chain_to_scene(camera, block)
        leave(lanes, block, d_means, d_scales, d_quats, d_means2d)


@part
def gather_labels(
    first: int, end: int, slots: Array, touched: Array, slot_labels: Array, channels: int, d_labels: Array
) -> None:
    """The label gradients of the Gaussians from ``first`` to before ``end``, zeros included: of d_labels [N * C]."""
    padded = padded_channels(channels)
    for i in range(first, end):
        own = d_labels[i * channels : (i + 1) * channels]
        own[:] = F(0.0)
        for slot in range(slots[i], slots[i + 1]):
            if touched[slot] != 0:
                for c in range(channels):
                    own[c] += slot_labels[slot * padded + c]


@parallel_kernel
def gather(
    worker: int, workers: int, next_portion: Array, slots: Array, touched: Array, labels: Any, geometry: Any
) -> None:
    """Portion after portion until none is left: the gradients of all N Gaussians. ``labels`` and ``geometry`` are the
    other arguments of ``gather_labels`` and of ``gather_geometry``."""
    count = slots.shape[0] - 1
    portions = portion_count(count)
    first, end = take_portion(next_portion, portions, count)
    while first < end:
        gather_geometry(worker, first, end, slots, touched, *geometry)
        gather_labels(first, end, slots, touched, *labels)
        first, end = take_portion(next_portion, portions, count)
