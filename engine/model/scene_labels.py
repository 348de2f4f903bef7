"""What the Gaussians of a finished scene show, decoded once for any number of frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .structured import GaussianLabels, LabelChannels, StructuredScene

LEAST_OF_CLASS = 0.1
"""Of a class's coverage, what an object of it needs at least to be shown: below that no object is there."""
CHUNK = 16384
"""Anchors decoded at a time, which bounds the memory beside the result."""
MOST_BYTES = 1 << 30
"""A larger table is not made: frames then decode what they show."""


@dataclass(frozen=True, eq=False)
class SceneLabels:
    """``probabilities`` float32 [M * k, C + U]: class probabilities of every Gaussian, which sum to 1, then those of
    the U instances. What these leave of 1 is the probability of no object."""

    probabilities: torch.Tensor


def shown_probabilities(classes: torch.Tensor, slots: torch.Tensor, channels: LabelChannels) -> torch.Tensor:
    """Probabilities (or coverage) of classes [..., C] and instances [..., U] together, [..., C + U], from those of the
    semantic channels [..., C] and of all slots [..., S].

    Where an object is of one class throughout, an instance gives all it has to its own class, and only what is no
    object's goes by the semantic channels. So an instance cannot be seen as another class than its own, nor a class
    take the id of an instance that nobody believes in there.
    """
    used = list(channels.instance_slots)
    instances = slots[..., used]
    if not channels.class_of_slot or not used:
        return torch.cat([classes, instances], dim=-1)
    alone = slots.sum(dim=-1, keepdim=True) - instances.sum(dim=-1, keepdim=True)
    total = classes.sum(dim=-1, keepdim=True).clamp_min(1e-8)
    by_class = classes * (alone / total)
    of_class = torch.tensor([channels.class_ids.index(channels.class_of_slot[slot]) for slot in used])
    return torch.cat([by_class.index_add(-1, of_class, instances), instances], dim=-1)


@torch.no_grad()
def scene_labels(scene: StructuredScene) -> SceneLabels | None:
    """The labels of a scene that does not change while they are used.

    None when labels depend on the view, or when there are too many to keep.
    """
    anchors, decoders, channels = scene.anchors, scene.decoders, scene.channels
    gaussians = len(anchors) * anchors.gaussians_per_anchor
    width = len(channels.class_ids) + len(channels.instance_slots)
    if scene.voted is not None:
        return SceneLabels(voted_probabilities(scene.voted, channels))
    if decoders.shape.label_view_input or 4 * gaussians * width > MOST_BYTES:
        return None
    probabilities = torch.empty(gaussians, width)
    start = 0
    for feature in anchors.feature.detach().split(CHUNK):
        classes, slots = (logits.flatten(0, 1).softmax(dim=1) for logits in decoders.label_logits(feature, feature))
        probabilities[start : start + len(classes)] = shown_probabilities(classes, slots, channels)
        start += len(classes)
    return SceneLabels(probabilities)


def voted_probabilities(voted: GaussianLabels, channels: LabelChannels) -> torch.Tensor:
    """The table of ``SceneLabels`` from the few labels that each Gaussian was voted to be."""
    classes = len(channels.class_ids)
    of_instance = [channels.class_ids.index(channels.class_of_slot[slot]) for slot in channels.instance_slots]
    class_of_label = torch.tensor([*range(classes), *of_instance])
    table = torch.zeros(len(voted.label), classes + len(of_instance))
    label = voted.label.long()
    table.scatter_add_(1, class_of_label[label], voted.share)
    owned = torch.where(label >= classes, voted.share, torch.zeros_like(voted.share))
    return table.scatter_add_(1, label, owned)
