"""From the pictures' gradients to the Gaussians': the kernels of the backward pass, one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from ..machine import memory
from ..machine.compiled import Array
from ..machine.crew import share, share_all, worker_count
from .forward_pass import ForwardState, scratch
from .gather import gather
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

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colours: Tensor
    labels: Tensor
    centres: Tensor

    @classmethod
    def empty(cls, count: int, channels: int) -> GaussianGradients:
        shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, channels), (count, 2))
        return cls(*map(memory.empty_tensor, shapes))

    def in_order(self) -> tuple[Tensor, ...]:
        return self.means, self.scales, self.quats, self.opacities, self.colours, self.labels, self.centres


@dataclass(frozen=True, eq=False)
class SlotGradients:
    """Of each of T pairs of Gaussian and tile: ``touched`` uint8 [T]; where that is 0 the others mean nothing. Floats
    [T * GRADIENT_WIDTH], and of labels [T * padded channels]."""

    touched: Array
    values: Array
    labels: Array


def unblend(
    state: ForwardState, means: Array, scales: Array, quats: Array, d_layers: LayerGradients
) -> GaussianGradients:
    """The gradients of all that was blended; means [N, 3], scales [N, 3] and quats [N, 4] as they were then."""
    workers, channels, lists = worker_count(), d_layers.labels.shape[2], state.lists
    slots = _unblend_tiles(workers, state, d_layers)
    gradients = GaussianGradients.empty(len(state.records), channels)
    calls = [(gather, _gather_arguments(workers, state, slots, (means, scales, quats), gradients))]
    if channels > 0:
        own_labels = gradients.labels.numpy().reshape(-1)
        own = (lists.slots, slots.touched, slots.labels, channels, own_labels)
        calls.append((state.kernels.gather_labels, own))
    share_all(workers, *calls)
    return gradients


def _gather_arguments(
    workers: int, state: ForwardState, slots: SlotGradients, scene: tuple[Array, ...], gradients: GaussianGradients
) -> tuple[Any, ...]:
    """All but the first two of ``gather``; ``scene`` is means, scales and quats."""
    return (
        state.lists.slots,
        slots.touched,
        slots.values,
        state.records,
        *scene,
        state.camera,
        memory.empty((workers, TILE), np.float64),
        gradients.means.numpy(),
        gradients.scales.numpy(),
        gradients.quats.numpy(),
        gradients.opacities.numpy(),
        gradients.colours.numpy(),
        gradients.centres.numpy(),
    )


def _unblend_tiles(workers: int, state: ForwardState, d_layers: LayerGradients) -> SlotGradients:
    kernels, lists = state.kernels, state.lists
    height, width, channels = d_layers.labels.shape
    pairs = len(lists.ids)
    slots = SlotGradients(
        memory.empty(pairs, np.uint8),
        memory.empty(pairs * GRADIENT_WIDTH, np.float32),
        memory.empty(pairs * padded_channels(channels), np.float32),
    )
    share(
        workers,
        kernels.unblend,
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
        *scratch(workers, kernels.unblend_scratch(channels), lists.longest),
    )
    return slots
