"""The kernels strung together as a ``torch.autograd.Function``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...machine import memory
from ...machine.threads import parallel_for, worker_count
from ..anchors import Anchors
from ..decoders import Decoders
from ..neural_gaussians import NeuralGaussians
from .backward import clear, decode_back
from .forward import decode_gaussians, decode_opacities
from .packing import BATCH, Layout, layout_of, packed, parameters_of, unpacked

PARTS = 32
"""Runs of batches whose weight gradients are summed apart; more workers than this find nothing to do."""


def decode_natively(
    anchors: Anchors,
    decoders: Decoders,
    visible: Tensor,
    centre: Tensor,
    channels: Tensor | None,
    known_labels: Tensor | None,
) -> NeuralGaussians:
    """As ``decode_rows``, for float32 tensors on the CPU. As many threads as ``torch.get_num_threads()``."""
    layout = layout_of(decoders.shape)
    nobody = torch.empty(0, dtype=torch.int64)
    fixed = _Fixed(
        visible.contiguous(),
        anchors.position,
        centre.float(),
        nobody if channels is None else channels,
        torch.empty(0, 0) if known_labels is None else known_labels,
        layout,
    )
    parameters = parameters_of(decoders)
    outputs = _Decode.apply(fixed, anchors.feature, anchors.offset, anchors.log_scale, *parameters)
    means, scales, quats, opacities, colours, labels, all_opacities, kept, cluster = outputs
    return NeuralGaussians(
        means=means,
        scales=scales,
        quats=quats,
        opacities=opacities,
        colours=colours,
        labels=labels,
        visible=visible,
        all_opacities=all_opacities,
        kept=kept,
        cluster_loss=cluster,
    )


class _Fixed:
    """What no gradient reaches, as the kernels take it."""

    def __init__(
        self, visible: Tensor, position: Tensor, centre: Tensor, channels: Tensor, known: Tensor, layout: Layout
    ) -> None:
        self.visible, self.position, self.centre = _flat(visible), _flat(position), _flat(centre)
        self.channels, self.known, self.known_channels = _flat(channels), _flat(known), known.shape[1]
        self.layout = layout
        labelled = int((self.channels[self.visible] >= 0).sum()) if len(self.channels) else 0
        self.clustered = max(labelled * layout.sizes.k, 1)
        self.batches = -(-len(visible) // BATCH)


def _flat(tensor: Tensor) -> NDArray[Any]:
    return tensor.detach().contiguous().reshape(-1).numpy()


def _scratch(workers: int, layout: Layout) -> tuple[NDArray[Any], NDArray[Any]]:
    return memory.empty((workers, layout.sizes.scratch), np.float32), memory.empty((workers, BATCH), np.int64)


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, fixed: _Fixed, feature: Tensor, offset: Tensor, log_scale: Tensor, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        layout, workers = fixed.layout, worker_count()
        sizes, batches, count = layout.sizes, fixed.batches, len(fixed.visible)
        weights = packed(list(parameters), layout)
        anchors = [_flat(tensor) for tensor in (feature, offset, log_scale)]
        scratch = _scratch(workers, layout)
        all_opacities, counts = memory.empty_tensor((count, sizes.k)), np.zeros(batches, np.int64)
        parallel_for(
            workers,
            decode_opacities,
            np.zeros(1, np.int64),
            fixed.visible,
            anchors[0],
            fixed.position,
            fixed.centre,
            weights,
            np.array(layout.heads),
            sizes,
            _flat(all_opacities),
            counts,
            *scratch,
        )
        starts, drawn = np.cumsum(counts) - counts, int(counts.sum())
        channels = fixed.known_channels if len(fixed.known) else sizes.classes + sizes.slots
        outputs = [memory.empty_tensor(shape) for shape in ((drawn, 3), (drawn, 3), (drawn, 4), (drawn,), (drawn, 3))]
        outputs.append(memory.empty_tensor((drawn, channels)))
        kept, losses = memory.empty(drawn, np.int64), np.zeros(batches)
        parallel_for(
            workers,
            decode_gaussians,
            np.zeros(1, np.int64),
            fixed.visible,
            anchors[0],
            fixed.position,
            *anchors[1:],
            fixed.centre,
            weights,
            np.array(layout.heads),
            sizes,
            _flat(all_opacities),
            starts,
            fixed.channels,
            fixed.known,
            fixed.known_channels,
            kept,
            *(_flat(output) for output in outputs),
            losses,
            *scratch,
        )
        kept_rows = torch.from_numpy(kept)
        ctx.mark_non_differentiable(all_opacities, kept_rows)
        ctx.save_for_backward(feature, offset, log_scale, *outputs, all_opacities)
        ctx.state = fixed, weights, starts
        cluster = torch.tensor(losses.sum() / fixed.clustered, dtype=torch.float32)
        return *outputs, all_opacities, kept_rows, cluster

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        fixed, weights, starts = ctx.state
        if len(fixed.known):
            raise RuntimeError("labels that were decoded before have no gradient; decode without them to train")
        feature, offset, log_scale, _, scales, _, _, colours, labels, all_opacities = ctx.saved_tensors
        layout, workers = fixed.layout, worker_count()
        d_anchors = [memory.empty_tensor(tuple(tensor.shape)) for tensor in (feature, offset, log_scale)]
        for gradient in d_anchors:
            parallel_for(workers, clear, _flat(gradient))
        d_weights = memory.empty((min(PARTS, fixed.batches), layout.parameters), np.float32)
        parallel_for(
            workers,
            decode_back,
            np.zeros(1, np.int64),
            fixed.visible,
            _flat(feature),
            fixed.position,
            _flat(offset),
            _flat(log_scale),
            fixed.centre,
            weights,
            np.array(layout.heads),
            layout.sizes,
            _flat(all_opacities),
            starts,
            fixed.channels,
            _flat(scales),
            _flat(colours),
            _flat(labels),
            *(_flat(gradient) for gradient in gradients[:6]),
            np.float32(float(gradients[8]) / fixed.clustered),
            *(_flat(gradient) for gradient in d_anchors),
            d_weights,
            *_scratch(workers, layout),
        )
        return None, *d_anchors, *unpacked(d_weights.sum(axis=0), layout)
