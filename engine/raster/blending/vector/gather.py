"""Label gradients of a Gaussian's intersections, added in order, sixteen at a time. The same steps as the plain twin in
``engine/raster/blending/gather.py``, whose other half serves here too."""

from __future__ import annotations

import numpy as np

from ....machine.compiled import Array, device_function, parallel_kernel
from ....machine.vectors import broadcast, get, lane_numbers, load, masked_store, store
from ...arrays import Blocks, GaussianGradients, IsectGradients, Shapes
from ...chunks import chunk_count, next_chunk
from ...records import TILE, padded_channels
from ..gather import gather_geometry

F = np.float32
ZERO = F(0.0)


@device_function
def gather_labels(
    chunk: tuple[int, int], offsets: Array, isects: IsectGradients, channels: int, d_labels: Array
) -> None:
    """As its plain twin."""
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
                store(d_labels, at, total)  # what is too much, the next Gaussians write over
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
    blocks: Blocks,
) -> None:
    """As its plain twin."""
    count = offsets.shape[0] - 1
    chunks = chunk_count(count)
    first, end = next_chunk(blocks.next_one, chunks, count)
    while first < end:
        gather_geometry((first, end), offsets, isects, scene, out, blocks.rows[worker])
        gather_labels((first, end), offsets, isects, channels, out.labels)
        first, end = next_chunk(blocks.next_one, chunks, count)
