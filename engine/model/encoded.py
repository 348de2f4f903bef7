"""Instances told apart by an encoding: the instance decoder gives each Gaussian a few numbers that are blended like a
colour, and a linear classifier says which slot a pixel's blend is.

Rivals' heads on our model, not the paper's way: in Gaussian Grouping the classifier is learnt with the encoding; in
Contrastive Lift it is made of the encodings' clusters at the end.
"""

from __future__ import annotations

import copy

import torch

from .decoders import Decoders, DecoderShape, drawn_layer

TINY = 1e-8


class EncodedDecoders(Decoders):
    """``Decoders`` whose instance decoder gives encodings, with the classifier of these."""

    def __init__(self, shape: DecoderShape, seed: int) -> None:
        super().__init__(shape, seed)
        generator = torch.Generator().manual_seed(seed + 1)
        self.classifier = drawn_layer(shape.encoding, shape.instance_slots, generator)

    def label_logits(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``Decoders.label_logits``: of the slots, what the classifier says of each Gaussian's own encoding."""
        classes, encodings = self.label_outputs(feature, seen)
        return classes, self.classifier(encodings[..., : self.shape.encoding])

    def drawn_instances(self, outputs: torch.Tensor) -> torch.Tensor:
        """The encodings themselves, [N, E]."""
        return outputs

    def slot_logits(self, blended: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """What the classifier says of encodings [..., E] (or of twins, by the first) that were blended up to ``alpha``
        [...]: [..., S]."""
        logits: torch.Tensor = self.classifier(blended[..., : self.shape.encoding] / (alpha[..., None] + TINY))
        return logits

    def slot_coverage(self, blended: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """The coverage of the slots, [..., S], which sums to ``alpha``."""
        return torch.softmax(self.slot_logits(blended, alpha), dim=-1) * alpha[..., None]


class TwinDecoders(EncodedDecoders):
    """``EncodedDecoders`` with a slow twin of the instance decoder, which is not learnt but follows it. Nor is the
    classifier learnt: until the end there is none that says anything."""

    def __init__(self, shape: DecoderShape, seed: int) -> None:
        super().__init__(shape, seed)
        self.slow = copy.deepcopy(self.instance).requires_grad_(False)
        self.classifier.requires_grad_(False)

    def label_outputs(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``Decoders.label_outputs``, of instances [V, k, 2 E]: the encodings, then the slow ones."""
        classes, encodings = super().label_outputs(feature, seen)
        with torch.no_grad():
            slow = self.slow(feature).view_as(encodings)
        return classes, torch.cat([encodings, slow], dim=-1)

    @torch.no_grad()
    def follow(self, momentum: float) -> None:
        """Move the twin towards the instance decoder; ``momentum`` of it stays."""
        for slow, fast in zip(self.slow.parameters(), self.instance.parameters(), strict=True):
            slow.lerp_(fast, 1.0 - momentum)
