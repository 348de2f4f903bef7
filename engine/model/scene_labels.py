"""What the Gaussians of a finished scene show, decoded once for any number of frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .structured import StructuredScene

CHUNK = 16384
"""Anchors decoded at a time, which bounds the memory beside the result."""
MOST_BYTES = 1 << 30
"""A larger table is not made: frames then decode what they show."""


@dataclass(frozen=True, eq=False)
class SceneLabels:
    """``probabilities`` float32 [M * k, C + U]: class probabilities of every Gaussian, then those of the U instance
    slots that are in use. Spare slots are left out: they are never shown."""

    probabilities: torch.Tensor


@torch.no_grad()
def scene_labels(scene: StructuredScene) -> SceneLabels | None:
    """The labels of a scene that does not change while they are used.

    None when labels depend on the view, or when there are too many to keep.
    """
    anchors, decoders, slot_ids = scene.anchors, scene.decoders, scene.channels.slot_ids
    used = torch.tensor([column for column, slot in enumerate(slot_ids) if slot], dtype=torch.int64)
    gaussians = len(anchors) * anchors.gaussians_per_anchor
    channels = decoders.shape.classes + len(used)
    if decoders.shape.label_view_input or 4 * gaussians * channels > MOST_BYTES:
        return None
    probabilities = torch.empty(gaussians, channels)
    start = 0
    for feature in anchors.feature.detach().split(CHUNK):
        classes, slots = (logits.flatten(0, 1).softmax(dim=1) for logits in decoders.label_logits(feature, feature))
        rows = probabilities[start : start + len(classes)]
        rows[:, : classes.shape[1]] = classes
        rows[:, classes.shape[1] :] = slots.index_select(1, used)
        start += len(classes)
    return SceneLabels(probabilities)
