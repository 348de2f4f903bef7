"""Instances told apart by an encoding: the instance decoder gives each Gaussian a few numbers that are blended like a
colour, and a linear classifier says which slot a pixel's blend belongs to.

In Gaussian Grouping the classifier is learnt with the encoding; in Contrastive Lift it is made from the encodings'
clusters at the end.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import nn

from engine.model.anchors import Anchors
from engine.model.decoders import DECODERS, Decoders, DecoderShape, ShownLabels, drawn_layer
from engine.model.scene_labels import CHUNK, shown_probabilities
from engine.model.structured import LabelChannels

TINY = 1e-8
LARGEST_ENCODING = 256
"""At most this many channels has an encoding in a model that is read."""


@dataclass(frozen=True)
class EncodedShape(DecoderShape):
    """``encoding``: channels that the instance decoder gives in place of logits of the slots."""

    encoding: int

    @property
    def instance_outputs(self) -> int:
        return self.encoding


class TwiceEncodedShape(EncodedShape):
    """Encodings are drawn twice, the second time as the slow decoder gives them."""

    @property
    def instance_channels(self) -> int:
        return 2 * self.encoding


class EncodedDecoders(Decoders):
    """``Decoders`` whose instance decoder gives encodings, with the classifier of these."""

    kind = "identity"
    shape_type = EncodedShape
    draws_own_labels = True

    def __init__(self, shape: EncodedShape, seed: int) -> None:
        super().__init__(shape, seed)
        generator = torch.Generator().manual_seed(seed + 1)
        self.classifier = drawn_layer(shape.encoding, shape.instance_slots, generator)

    @classmethod
    def weight_sizes(cls, shape: EncodedShape) -> dict[str, tuple[int, ...]]:
        """As ``Decoders.weight_sizes``."""
        classifier = {"classifier.weight": (shape.instance_slots, shape.encoding)}
        return {**super().weight_sizes(shape), **classifier, "classifier.bias": (shape.instance_slots,)}

    @classmethod
    def check_shape(cls, shape: EncodedShape) -> None:
        """As ``Decoders.check_shape``."""
        super().check_shape(shape)
        if shape.encoding > LARGEST_ENCODING:
            raise ValueError(f"the encoding has more than {LARGEST_ENCODING} channels")
        if shape.label_view_input:
            raise ValueError("an encoding is the same from every direction")

    def learnt(self) -> Iterator[tuple[str, list[nn.Parameter]]]:
        """As ``Decoders.learnt``; the classifier is learnt as fast as the encodings."""
        for name, parameters in super().learnt():
            yield "instance" if name == "classifier" else name, parameters

    def own_labels(self, anchors: Anchors, channels: LabelChannels) -> EncodedLabels:
        """Class probabilities and encoding of every Gaussian."""
        parts = []
        for feature in anchors.feature.detach().split(CHUNK):
            classes, encodings = (each.flatten(0, 1) for each in self.label_outputs(feature, feature))
            parts.append(torch.cat([classes.softmax(dim=1), encodings], dim=1))
        return EncodedLabels(torch.cat(parts), self, channels)

    def label_logits(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``Decoders.label_logits``: of the slots, what the classifier says of each Gaussian's own encoding."""
        classes, encodings = self.label_outputs(feature, seen)
        return classes, self.classifier(encodings[..., : self.shape.encoding])

    def drawn_instances(self, outputs: torch.Tensor) -> torch.Tensor:
        """The encodings themselves, [N, E]."""
        return outputs

    def slot_logits(self, blended: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """What the classifier says of encodings [..., E] (or of both, by the first) that were blended up to ``alpha``
        [...]: [..., S]."""
        logits: torch.Tensor = self.classifier(blended[..., : self.shape.encoding] / (alpha[..., None] + TINY))
        return logits

    def slot_coverage(self, blended: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """The coverage of the slots, [..., S], which sums to ``alpha``."""
        return torch.softmax(self.slot_logits(blended, alpha), dim=-1) * alpha[..., None]


class FollowedDecoders(EncodedDecoders):
    """``EncodedDecoders`` with a slow copy of the instance decoder, which is not learnt but follows it (a momentum
    teacher). Nor is the classifier learnt: until the end it says nothing."""

    kind = "contrastive"
    shape_type = TwiceEncodedShape

    def __init__(self, shape: EncodedShape, seed: int) -> None:
        super().__init__(shape, seed)
        self.slow = copy.deepcopy(self.instance).requires_grad_(False)
        self.classifier.requires_grad_(False)

    @classmethod
    def sides(cls, shape: EncodedShape) -> dict[str, tuple[int, int]]:
        """As ``Decoders.sides``."""
        sides = super().sides(shape)
        return {**sides, "slow": sides["instance"]}

    def label_outputs(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``Decoders.label_outputs``, of instances [V, k, 2 E]: the encodings, then the slow ones."""
        classes, encodings = super().label_outputs(feature, seen)
        with torch.no_grad():
            slow = self.slow(feature).view_as(encodings)
        return classes, torch.cat([encodings, slow], dim=-1)

    @torch.no_grad()
    def follow(self, momentum: float) -> None:
        """Move the slow decoder towards the instance decoder; it keeps ``momentum`` of itself."""
        for slow, fast in zip(self.slow.parameters(), self.instance.parameters(), strict=True):
            slow.lerp_(fast, 1.0 - momentum)


@dataclass(frozen=True, eq=False)
class EncodedLabels(ShownLabels):
    """What is drawn where encodings tell instances apart: each pixel's blend is classified. ``columns`` float32
    [M * k, C + E]: class probabilities and encoding of every Gaussian."""

    columns: torch.Tensor
    decoders: EncodedDecoders
    channels: LabelChannels

    def of(self, rows: torch.Tensor) -> torch.Tensor:
        """As ``ShownLabels.of``: [N, C + E]."""
        return self.columns.index_select(0, rows)

    def shown(self, drawn: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """As ``ShownLabels.shown``."""
        classes = len(self.channels.class_ids)
        slots = self.decoders.slot_coverage(drawn[..., classes:], alpha)
        return shown_probabilities(drawn[..., :classes], slots, self.channels)


DECODERS[EncodedDecoders.kind] = EncodedDecoders
DECODERS[FollowedDecoders.kind] = FollowedDecoders
