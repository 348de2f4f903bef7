"""From the pictures' gradients to the Gaussians': the kernels of the backward pass, one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..machine import memory
from ..machine.compiled import Array
from ..machine.threads import parallel_for, worker_count
from .chain_to_scene import CHAIN_BLOCK
from .forward_pass import ForwardState, scratch
from .records import GRADIENT_WIDTH, TILE, padded_channels


@dataclass(frozen=True, eq=False)
class LayerGradients:
    """Of image [H, W, 3], labels [H, W, C] (no channels where none are wanted), alpha and depth [H, W]."""

    image: Array
    labels: Array
    alpha: Array
    depth: Array


@dataclass(frozen=True, eq=False)
class GaussianGradients:
    """In the order of ``rasterize``'s arguments, and of the centres on the image [N, 2]."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colours: Array
    labels: Array
    centres: Array

    @classmethod
    def empty(cls, count: int, channels: int) -> GaussianGradients:
        shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, 2))
        *geometry, centres = memory.several(*((shape, np.float32) for shape in shapes))
        return cls(*geometry, memory.empty((count, channels), np.float32), centres)

    def in_order(self) -> tuple[Array, ...]:
        return self.means, self.scales, self.quats, self.opacities, self.colours, self.labels, self.centres


@dataclass(frozen=True, eq=False)
class SlotGradients:
    """Of each of T pairs of Gaussian and tile: ``touched`` uint8 [T]; where that is 0 the others mean nothing. Floats
    [T * GRADIENT_WIDTH], and of labels [T * padded channels]."""

    touched: Array
    values: Array
    labels: Array

    @classmethod
    def empty(cls, pairs: int, channels: int) -> SlotGradients:
        labels = pairs * padded_channels(channels)
        return cls(*memory.several((pairs, np.uint8), (pairs * GRADIENT_WIDTH, np.float32), (labels, np.float32)))


def unblend(
    state: ForwardState, means: Array, scales: Array, quats: Array, d_layers: LayerGradients
) -> GaussianGradients:
    """The gradients of all that was blended; means [N, 3], scales [N, 3] and quats [N, 4] as they were then."""
    workers, channels, pairs = worker_count(), d_layers.labels.shape[2], len(state.lists.ids)
    slots = SlotGradients.empty(pairs, channels)
    gradients = GaussianGradients.empty(len(state.records), channels)
    # all is made ready before the first kernel, which throws what Python needs out of the caches
    unblending = _unblending(workers, state, d_layers, slots)
    labels = slots.labels, channels, gradients.labels.reshape(-1)
    next_portion = np.zeros(1, np.int64)
    geometry = _geometry(workers, state, slots, (means, scales, quats), gradients)
    parallel_for(workers, state.kernels.unblend, *unblending)
    parallel_for(workers, state.kernels.gather, next_portion, state.lists.slots, slots.touched, labels, geometry)
    return gradients


def _geometry(
    workers: int, state: ForwardState, slots: SlotGradients, scene: tuple[Array, ...], gradients: GaussianGradients
) -> tuple[Any, ...]:
    """All but the first five arguments of ``gather_geometry``; ``scene`` is means, scales and quats."""
    return (
        slots.values,
        state.records,
        *scene,
        state.camera,
        *memory.several(((workers, TILE), np.float64), ((workers, CHAIN_BLOCK), np.float64)),
        gradients.means,
        gradients.scales,
        gradients.quats,
        gradients.opacities,
        gradients.colours,
        gradients.centres,
    )


def _unblending(workers: int, state: ForwardState, d_layers: LayerGradients, slots: SlotGradients) -> tuple[Any, ...]:
    """The arguments of ``unblend_tiles``."""
    lists = state.lists
    height, width, channels = d_layers.labels.shape
    return (
        np.zeros(1, np.int64),
        lists.starts,
        lists.ids,
        lists.tile_slots,
        state.records.reshape(-1),
        state.rest,
        state.last,
        d_layers.image.reshape(-1),
        d_layers.labels.reshape(-1),
        channels,
        d_layers.alpha.reshape(-1),
        d_layers.depth.reshape(-1),
        width,
        height,
        slots.touched,
        slots.values,
        slots.labels,
        *scratch(workers, state.kernels.unblend_scratch(channels), lists.longest),
    )
