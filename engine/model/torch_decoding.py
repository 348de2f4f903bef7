"""Decoding in plain torch, for any device and precision; tests compare the kernels of ``decoding`` with it."""

from __future__ import annotations

from typing import Any

import torch
from torch.nn import functional

from .anchors import AnchorsInView
from .decoders import Decoders, run_side_by_side
from .neural_gaussians import NeuralGaussians

# Selection of rows of a tensor without repetitions: the backward pass is then a plain copy.
#
# PyTorch's own indexing must expect repeated rows and adds them up one by one, which takes longer than the decoders.


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = tensor.shape
        return tensor.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        (rows,) = ctx.saved_tensors
        (gradient,) = gradients
        return gradient.new_zeros(ctx.shape).index_copy_(0, rows, gradient), None


def take_rows(
    tensor: torch.Tensor,  # [M, ...]
    rows: torch.Tensor,  # int64 [N]
) -> torch.Tensor:
    """Return ``tensor[rows]``, for rows without repetitions. This is not checked: repeated rows would lose gradient."""
    taken: torch.Tensor = _TakeRows.apply(tensor, rows)
    return taken


def decode_in_torch(given: AnchorsInView, decoders: Decoders) -> NeuralGaussians:
    """Decode the anchors in ``given`` to Gaussians in plain torch, on any device."""
    anchors, visible, centre, channels, known_labels = given
    position = anchors.position.index_select(0, visible)
    feature = take_rows(anchors.feature, visible)
    seen = decoders.view_input(feature, position, centre)
    k = anchors.gaussians_per_anchor

    networks = (decoders.opacity, decoders.covariance, decoders.colour)
    opacity, covariance, colour = run_side_by_side(seen, *networks)  # [V, k], [V, 7 k] and [V, 3 k]
    opacity = torch.tanh(opacity)
    kept = (opacity.detach().reshape(-1) > 0).nonzero().squeeze(1)
    owner = kept // k
    shape = take_rows(covariance.view(-1, 7), kept)
    owner_scale = take_rows(anchors.log_scale, visible).exp().index_select(0, owner)
    offset = take_rows(take_rows(anchors.offset, visible).view(-1, 3), kept)
    cluster = feature.new_zeros(())
    if known_labels is not None:
        labels = known_labels.index_select(0, visible.index_select(0, owner) * k + kept % k)
    else:
        classes, instances = decoders.label_logits(feature, seen)
        by_class = torch.softmax(take_rows(classes.flatten(0, 1), kept), dim=1)
        by_slot = torch.softmax(take_rows(instances.flatten(0, 1), kept), dim=1)
        labels = torch.cat([by_class, by_slot], dim=1)
        if channels is not None:
            cluster = cluster_loss(classes, channels.index_select(0, visible))
    return NeuralGaussians(
        means=position.index_select(0, owner) + offset * owner_scale[:, :3],
        scales=owner_scale[:, 3:] * torch.sigmoid(shape[:, :3]),
        quats=shape[:, 3:],
        opacities=take_rows(opacity.reshape(-1), kept),
        colours=torch.sigmoid(take_rows(colour.view(-1, 3), kept)),
        labels=labels,
        visible=visible,
        all_opacities=opacity.detach(),
        kept=kept,
        cluster_loss=cluster,
    )


def cluster_loss(
    class_logits: torch.Tensor,  # [V, k, C]
    target: torch.Tensor,  # int64 [V], -1 = no label
) -> torch.Tensor:
    """Return L_cluster (equation "Cluster Loss"): the mean cross entropy over all k Gaussians, drawn or not, of visible
    anchors with a label, a scalar."""
    known, k = target >= 0, class_logits.shape[1]
    wanted = target.clamp_min(0)[:, None, None].expand(-1, k, 1)
    # torch's own cross entropy of millions of rows takes ten times as long on a GPU
    log = functional.log_softmax(class_logits, dim=2).gather(2, wanted).squeeze(2)
    return -(log * known[:, None]).sum() / (k * known.sum()).clamp_min(1)
