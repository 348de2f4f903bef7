"""Combines the kernels to a ``torch.autograd.Function``."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...machine import memory
from ...machine.threads import parallel_for, worker_count
from ..anchors import AnchorsInView
from ..decoders import Decoders
from ..neural_gaussians import NeuralGaussians
from . import packing
from .backward import decode_backward
from .forward import decode_gaussians, decode_opacities

CHUNKS = 32
"""Chunks of batches with separate sums of weight gradients; also the maximum number of useful workers."""


def decode_natively(given: AnchorsInView, decoders: Decoders) -> NeuralGaussians:
    """Decode ``given`` with compiled kernels: float32 on the CPU, with ``torch.get_num_threads()`` threads."""
    anchors, visible, centre, channels, known_labels = given
    layout = packing.layout_of(decoders.shape)
    labels = torch.empty(0, 0) if known_labels is None else known_labels
    wanted = torch.empty(0, dtype=torch.int64) if channels is None else channels
    labelling = packing.Labelling(_flat(wanted), _flat(labels), labels.shape[1])
    fixed = _Fixed(_flat(visible), _flat(anchors.position), _flat(centre.float()), labelling, layout)
    outputs = _Decode.apply(fixed, anchors.feature, anchors.offset, anchors.log_scale, *packing.parameters_of(decoders))
    means, scales, quats, opacities, colours, labels, all_opacities, cluster = outputs
    return NeuralGaussians(
        means=means,
        scales=scales,
        quats=quats,
        opacities=opacities,
        colours=colours,
        labels=labels,
        visible=visible,
        all_opacities=all_opacities,
        kept=(all_opacities.view(-1) > 0).nonzero().squeeze(1),
        cluster_loss=cluster,
    )


class _Fixed(NamedTuple):
    """The inputs of decoding without a gradient, kept for the backward pass: which anchors, the camera, the layout."""

    visible: NDArray[np.int64]
    position: NDArray[np.float32]
    centre: NDArray[np.float32]
    labelling: packing.Labelling
    layout: packing.Layout

    def anchors(self, feature: Tensor, offset: Tensor, log_scale: Tensor) -> packing.AnchorArrays:
        learnt = _flat(feature), _flat(offset), _flat(log_scale)
        return packing.AnchorArrays(self.visible, learnt[0], self.position, self.centre, *learnt[1:])

    def clustered(self) -> int:
        """Return over how many Gaussians the cluster loss is averaged, at least 1."""
        channels = self.labelling.channels
        labelled = np.count_nonzero(channels[self.visible] >= 0) if len(channels) else 0
        return max(labelled * self.layout.sizes.k, 1)


def _flat(tensor: Tensor) -> NDArray[Any]:
    return tensor.detach().contiguous().reshape(-1).numpy()


def _new_work(workers: int, layout: packing.Layout) -> packing.Work:
    sizes = layout.sizes
    wanted = ((workers, sizes.scratch), np.float32), ((workers, packing.BATCH * (1 + 2 * sizes.k)), np.int64)
    return packing.Work(np.zeros(1, np.int64), *memory.several(*wanted))


def _empty(shape: tuple[int, ...]) -> Tensor:
    """Return an uninitialised float32 tensor in memory that is reused."""
    return torch.from_numpy(memory.empty(shape, np.float32))


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, fixed: _Fixed, feature: Tensor, offset: Tensor, log_scale: Tensor, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        layout, workers, labelling = fixed.layout, worker_count(), fixed.labelling
        sizes, visible = layout.sizes, len(fixed.visible)
        weights = packing.Packed(packing.packed(list(parameters), layout), np.array(layout.heads), layout.sizes)
        anchors = fixed.anchors(feature, offset, log_scale)
        all_opacities, counts = _empty((visible, sizes.k)), np.zeros(-(-visible // packing.BATCH), np.int64)
        opacities = _flat(all_opacities)
        parallel_for(workers, decode_opacities, anchors, weights, opacities, counts, _new_work(workers, layout))
        batches = packing.Batches(opacities, np.cumsum(counts) - counts, np.zeros(len(counts)))
        given = packing.Decoding(anchors, weights, labelling, batches)
        channels = labelling.known_channels if len(labelling.known) else sizes.classes + sizes.slots
        count = int(counts.sum())
        shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, channels))
        outputs = [_empty(shape) for shape in shapes]
        drawn = packing.Drawn(*map(_flat, outputs))
        work = _new_work(workers, layout)
        parallel_for(workers, decode_gaussians, given, drawn, work)
        ctx.mark_non_differentiable(all_opacities)
        ctx.save_for_backward(feature, offset, log_scale, *outputs)
        ctx.state = fixed, weights, batches
        cluster = torch.tensor(batches.losses.sum() / fixed.clustered(), dtype=torch.float32)
        return *outputs, all_opacities, cluster

    @staticmethod
    def backward(ctx: Any, *by: Tensor) -> tuple[Tensor | None, ...]:
        fixed, weights, batches = ctx.state
        learnt, outputs = ctx.saved_tensors[:3], ctx.saved_tensors[3:]
        layout, workers = fixed.layout, worker_count()
        d_anchors = [_empty(tuple(tensor.shape)).zero_() for tensor in learnt]
        d_weights = memory.empty((min(CHUNKS, len(batches.starts)), layout.parameters), np.float32)
        drawn, by_drawn = packing.Drawn(*map(_flat, outputs)), packing.Drawn(*map(_flat, by[:6]))
        of_feature, of_offset, of_scale = map(_flat, d_anchors)
        by_loss = float(by[7]) / fixed.clustered()
        gradients = packing.Gradients(drawn, by_drawn, by_loss, of_feature, of_offset, of_scale, d_weights)
        work = _new_work(workers, layout)
        given = packing.Decoding(fixed.anchors(*learnt), weights, fixed.labelling, batches)
        parallel_for(workers, decode_backward, given, gradients, work)
        return None, *d_anchors, *packing.unpacked(d_weights.sum(axis=0), layout)
