"""From the gradients of pictures to those of Gaussians: backward blending, sums over tiles, backward projection."""

from __future__ import annotations

import numpy as np

from ..machine import memory
from ..machine.threads import parallel_for, worker_count
from .arrays import GaussianGradients, IsectGradients, PixelGradients, Shapes, Size, flat
from .blending.backward import blend_backward
from .blending.backward_tile import scratch_size
from .blending.gather import gather
from .forward_pass import ForwardState, Layers, new_scratch
from .records import GRADIENT_WIDTH, padded_channels


def rasterize_backward(state: ForwardState, shapes: Shapes, d_layers: Layers) -> GaussianGradients:
    """The gradients of everything that was blended.

    ``shapes`` are those of the forward pass; ``d_layers``: the layers' gradients, whose labels have no channels if
    none are wanted.
    """
    height, width, channels = d_layers.labels.shape
    size, workers = Size(width, height, channels), worker_count()
    isects = _no_isect_gradients(len(state.isects.flatten_ids), channels)
    out = _no_gradients(len(state.records), channels)
    images = map(flat, d_layers.in_order())
    pixels = PixelGradients(*images, state.final, state.last)
    scratch = new_scratch(workers, scratch_size(channels))
    parallel_for(workers, blend_backward, state.isects, flat(state.records), pixels, size, isects, scratch)
    scene = (shapes, state.records, state.camera)
    flat_out = out._replace(labels=flat(out.labels))
    parallel_for(
        workers, gather, state.isects.gaussian_offsets, isects, channels, scene, flat_out, np.zeros(1, np.int64)
    )
    return out


def _no_isect_gradients(count: int, channels: int) -> IsectGradients:
    """Arrays for the gradients of ``count`` intersections, to be filled."""
    labels = count * padded_channels(channels)
    return IsectGradients(
        *memory.several((count, np.uint8), (count * GRADIENT_WIDTH, np.float32), (labels, np.float32))
    )


def _no_gradients(count: int, channels: int) -> GaussianGradients:
    """Arrays for the gradients of ``count`` Gaussians, to be filled."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, 2))
    *geometry, means2d = memory.several(*((shape, np.float32) for shape in shapes))
    return GaussianGradients(*geometry, memory.empty((count, channels), np.float32), means2d)
