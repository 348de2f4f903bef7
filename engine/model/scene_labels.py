"""The labels that a finished scene's Gaussians show, decoded once for any number of frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .structured import GaussianLabels, LabelChannels, StructuredScene

CHUNK = 16384
"""Anchors decoded at once. This bounds the memory in addition to the result."""
MOST_BYTES = 1 << 30
"""The most bytes of a table. Without a table, every frame decodes its labels."""


@dataclass(frozen=True, eq=False)
class SceneLabels:
    """The probabilities of every Gaussian's labels, float32 [M * k, C + U]: of the classes, which sum to 1, then of the
    U instances, which sum to 1 together with "no object"."""

    probabilities: torch.Tensor

    def of(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the probabilities of the Gaussians with the indices ``rows`` int64 [N], float32 [N, C + U]."""
        return self.probabilities.index_select(0, rows)


@dataclass(frozen=True, eq=False)
class VotedLabels:
    """The same as ``SceneLabels``, computed from the few labels voted for each Gaussian, in memory that does not grow
    with the number of labels. ``class_of_label`` int64 [C + U]: the semantic channel of each label."""

    voted: GaussianLabels
    classes: int
    class_of_label: torch.Tensor

    @classmethod
    def of_scene(cls, voted: GaussianLabels, channels: LabelChannels) -> VotedLabels:
        classes = len(channels.class_ids)
        of_instance = [channels.class_ids.index(channels.class_of_slot[slot]) for slot in channels.instance_slots]
        return cls(voted, classes, torch.tensor([*range(classes), *of_instance]))

    def of(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the probabilities of the Gaussians with the indices ``rows`` int64 [N], float32 [N, C + U]."""
        label = self.voted.label.index_select(0, rows).long()
        share = self.voted.share.index_select(0, rows)
        table = share.new_zeros(len(rows), len(self.class_of_label))
        table.scatter_add_(1, self.class_of_label.to(label.device)[label], share)
        owned = torch.where(label >= self.classes, share, torch.zeros_like(share))
        return table.scatter_add_(1, label, owned)


ShownLabels = SceneLabels | VotedLabels


def shown_probabilities(
    classes: torch.Tensor,  # [..., C]
    slots: torch.Tensor,  # [..., S]
    channels: LabelChannels,
) -> torch.Tensor:
    """Return the probabilities (or coverage) to show, of classes and U instances, [..., C + U]. If each object has one
    class, an instance's probability counts for its own class, and only what no instance has follows the semantic
    channels. So an instance never shows with a class other than its own, and a class never with the id of an instance
    that is not there."""
    used = list(channels.instance_slots)
    instances = slots[..., used]
    if not channels.class_of_slot or not used:
        return torch.cat([classes, instances], dim=-1)
    alone = slots.sum(dim=-1, keepdim=True) - instances.sum(dim=-1, keepdim=True)
    total = classes.sum(dim=-1, keepdim=True).clamp_min(1e-8)
    by_class = classes * (alone / total)
    of_class = torch.tensor([channels.class_ids.index(channels.class_of_slot[slot]) for slot in used])
    return torch.cat([by_class.index_add(-1, of_class.to(slots.device), instances), instances], dim=-1)


def shown_labels(scene: StructuredScene) -> ShownLabels | None:
    """Return the labels that a finished scene's Gaussians show: voted or decoded; None if each view decodes its own."""
    return scene_labels(scene) if scene.voted is None else VotedLabels.of_scene(scene.voted, scene.channels)


@torch.no_grad()
def scene_labels(scene: StructuredScene) -> ShownLabels | None:
    """Decode the labels of all Gaussians of a scene that no longer changes. Return None if they depend on the
    viewpoint, or are too many to keep."""
    anchors, decoders, channels = scene.anchors, scene.decoders, scene.channels
    gaussians = len(anchors) * anchors.gaussians_per_anchor
    width = len(channels.class_ids) + len(channels.instance_slots)
    if decoders.shape.label_view_input or 4 * gaussians * width > MOST_BYTES:
        return None
    probabilities = anchors.position.new_empty(gaussians, width)
    start = 0
    for feature in anchors.feature.detach().split(CHUNK):
        classes, slots = (logits.flatten(0, 1).softmax(dim=1) for logits in decoders.label_logits(feature, feature))
        probabilities[start : start + len(classes)] = shown_probabilities(classes, slots, channels)
        start += len(classes)
    return SceneLabels(probabilities)
