"""From the pictures' gradients to the Gaussians': blending backward, sums over tiles, projection backward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..machine import memory
from ..machine.compiled import Array
from ..machine.threads import parallel_for, worker_count
from .arrays import Blocks, GaussianGradients, IsectGradients, PixelGradients, Shapes, Size, flat
from .forward_pass import ForwardState, new_scratch
from .projection.backward import GRADIENT_BLOCK
from .records import GRADIENT, GRADIENT_WIDTH, padded_channels


@dataclass(frozen=True, eq=False)
class LayerGradients:
    """Of image [H, W, 3], labels [H, W, C] (no channels where none are wanted), alpha and depth [H, W]."""

    image: Array
    labels: Array
    alpha: Array
    depth: Array


def rasterize_backward(state: ForwardState, shapes: Shapes, d_layers: LayerGradients) -> GaussianGradients:
    """The gradients of all that was blended; ``shapes`` as they were then."""
    height, width, channels = d_layers.labels.shape
    size, workers = Size(width, height, channels), worker_count()
    isects = _no_isect_gradients(len(state.isects.flatten_ids), channels)
    out = _no_gradients(len(state.records), channels)
    images = map(flat, (d_layers.image, d_layers.labels, d_layers.alpha, d_layers.depth))
    pixels = PixelGradients(*images, state.final, state.last)
    scratch = new_scratch(workers, state.kernels.backward_scratch(channels), state.longest)
    parallel_for(
        workers, state.kernels.blend_backward, state.isects, flat(state.records), pixels, size, isects, scratch
    )
    blocks = Blocks(np.zeros(1, np.int64), memory.empty((workers, GRADIENT + GRADIENT_BLOCK), np.float64))
    scene = (shapes, state.records, state.camera)
    flat_out = out._replace(labels=flat(out.labels))
    parallel_for(
        workers, state.kernels.gather, state.isects.gaussian_offsets, isects, channels, scene, flat_out, blocks
    )
    return out


def _no_isect_gradients(count: int, channels: int) -> IsectGradients:
    """Of so many intersections, to be filled."""
    labels = count * padded_channels(channels)
    return IsectGradients(
        *memory.several((count, np.uint8), (count * GRADIENT_WIDTH, np.float32), (labels, np.float32))
    )


def _no_gradients(count: int, channels: int) -> GaussianGradients:
    """Of so many Gaussians, to be filled."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, 2))
    *geometry, means2d = memory.several(*((shape, np.float32) for shape in shapes))
    return GaussianGradients(*geometry, memory.empty((count, channels), np.float32), means2d)
