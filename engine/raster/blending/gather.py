"""Gradients of a Gaussian's intersections, added in order, and carried back to its 3D parameters."""

from __future__ import annotations

import numpy as np

from ...machine.compiled import Array, device_function, parallel_kernel
from ..arrays import Blocks, GaussianGradients, IsectGradients, Shapes
from ..chunks import chunk_count, next_chunk
from ..projection.backward import load_gradient_lane, project_block_backward, store_gradient_lanes
from ..projection.lanes import LANES
from ..records import (
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


@device_function
def clear(i: int, out: GaussianGradients) -> None:
    """No gradient of Gaussian i but that of its labels, which are not looked at."""
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
    room: Array,
) -> None:
    """The gradients of the Gaussians of a chunk (the first, and the one behind the last) but for their labels, zeros
    included; ``room`` float64 [GRADIENT_BLOCK + GRADIENT] to work in. ``scene``: shapes, records, camera."""
    shapes, records, camera = scene
    total, block = room[:GRADIENT], room[GRADIENT:]
    touched, values = isects.touched, isects.values
    first, end = chunk
    lanes = 0
    for i in range(first, end):
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
        load_gradient_lane(i, lanes, total, records, shapes, block)
        lanes += 1
        if lanes == LANES:
            project_block_backward(camera, block)
            store_gradient_lanes(lanes, block, out)
            lanes = 0
    if lanes > 0:
        project_block_backward(camera, block)
        store_gradient_lanes(lanes, block, out)


@device_function
def gather_labels(
    chunk: tuple[int, int], offsets: Array, isects: IsectGradients, channels: int, d_labels: Array
) -> None:
    """The label gradients of the Gaussians of a chunk, zeros included: of d_labels [N * C]."""
    padded, touched, labels = padded_channels(channels), isects.touched, isects.labels
    first, end = chunk
    for i in range(first, end):
        own = d_labels[i * channels : (i + 1) * channels]
        own[:] = F(0.0)
        for isect in range(offsets[i], offsets[i + 1]):
            if touched[isect] != 0:
                for c in range(channels):
                    own[c] += labels[isect * padded + c]


@parallel_kernel
def gather(
    worker: int,
    workers: int,
    offsets: Array,
    isects: IsectGradients,
    channels: int,
    scene: tuple[Shapes, Array, Array],
    out: GaussianGradients,
    blocks: Blocks,
) -> None:
    """Chunk after chunk until none is left: the gradients of all N Gaussians, of their labels as [N * C].

    ``offsets`` int64 [N + 1] as ``Intersections.gaussian_offsets``. ``scene``: the shapes, the records [N, RECORD] and
    the camera of the forward pass.
    """
    count = offsets.shape[0] - 1
    chunks = chunk_count(count)
    first, end = next_chunk(blocks.next_one, chunks, count)
    while first < end:
        gather_geometry((first, end), offsets, isects, scene, out, blocks.rows[worker])
        gather_labels((first, end), offsets, isects, channels, out.labels)
        first, end = next_chunk(blocks.next_one, chunks, count)
