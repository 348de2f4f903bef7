"""Gradients of a Gaussian's intersections, which are added in order and carried back to its 3D parameters."""

from __future__ import annotations

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ...machine.vectors import broadcast, get, lane_numbers, load, masked_store, store
from ..arrays import GaussianGradients, IsectGradients, Shapes
from ..chunks import chunk_count, next_chunk
from ..projection_backward import project_backward
from ..records import (
    D_BLUE,
    D_GREEN,
    D_RED,
    GRADIENT,
    GRADIENT_WIDTH,
    OPACITY,
    TILE,
    G,
    padded_channels,
)

F = np.float32
ZERO = F(0.0)


@device_function
def clear(i: int, out: GaussianGradients) -> None:
    """Zero the gradients of Gaussian i, but not those of its labels."""
    out.opacities[i] = F(0.0)
    for c in range(2):
        out.means2d[i, c] = F(0.0)
    for c in range(3):
        out.means[i, c] = F(0.0)
        out.scales[i, c] = F(0.0)
        out.colours[i, c] = F(0.0)
    for c in range(4):
        out.quats[i, c] = F(0.0)


@device_function
def gather_geometry(
    chunk: tuple[int, int],
    offsets: Array,
    isects: IsectGradients,
    scene: tuple[Shapes, Array, Array],
    out: GaussianGradients,
    total: Array,
) -> None:
    """Write the gradients of the Gaussians of a chunk (the first, and one past the last) except labels, including
    zeros. ``scene``: shapes, records, camera; ``total`` float64 [GRADIENT] is scratch."""
    shapes, records, camera = scene
    touched, values = isects.touched, isects.values
    for i in range(chunk[0], chunk[1]):
        hit = False
        for c in range(GRADIENT):
            total[c] = 0.0
        for isect in range(offsets[i], offsets[i + 1]):
            if touched[isect] == 0:
                continue
            for c in range(GRADIENT):
                total[c] += np.float64(values[isect * GRADIENT_WIDTH + c])
            hit = True
        if not hit:
            clear(i, out)
            continue
        out.opacities[i] = total[G] / np.float64(records[i, OPACITY])
        out.colours[i, 0] = total[D_RED]
        out.colours[i, 1] = total[D_GREEN]
        out.colours[i, 2] = total[D_BLUE]
        project_backward(i, total, records[i], shapes, camera, out)


@device_function
def gather_labels(
    chunk: tuple[int, int], offsets: Array, isects: IsectGradients, channels: int, d_labels: Array
) -> None:
    """Write the label gradients of the Gaussians of a chunk, including zeros, to d_labels [N * C]."""
    padded, touched, labels = padded_channels(channels), isects.touched, isects.labels
    first, end = chunk
    in_tail = lane_numbers() < broadcast(F(channels - padded + TILE))
    for i in range(first, end):
        first_isect, last_isect = get(offsets, i), get(offsets, i + 1)
        for c in range(0, padded, TILE):
            total = broadcast(ZERO)
            for isect in range(first_isect, last_isect):
                if get(touched, isect) != 0:
                    total = total + load(labels, isect * padded + c)
            at = i * channels + c
            if at + TILE <= end * channels:
                store(d_labels, at, total)  # the next Gaussians overwrite what is too much
            else:
                masked_store(d_labels, at, total, in_tail)


@parallel_kernel
def gather(
    worker: int,
    workers: int,
    offsets: Array,
    isects: IsectGradients,
    channels: int,
    scene: tuple[Shapes, Array, Array],
    out: GaussianGradients,
    next_one: Array,
) -> None:
    """Process one chunk after another until none is left: the gradients of all N Gaussians, with labels as [N * C].

    ``offsets`` int64 [N + 1] is ``Intersections.gaussian_offsets``. ``scene``: the shapes, the records [N, RECORD] and
    the camera of the forward pass. ``next_one`` int64 [1] is the next chunk to take.
    """
    count, total = offsets.shape[0] - 1, np.empty(GRADIENT, np.float64)
    chunks = chunk_count(count)
    first, end = next_chunk(next_one, chunks, count)
    while first < end:
        gather_geometry((first, end), offsets, isects, scene, out, total)
        gather_labels((first, end), offsets, isects, channels, out.labels)
        first, end = next_chunk(next_one, chunks, count)
