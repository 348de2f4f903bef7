"""Instances told apart by an encoding: the instance decoder gives each Gaussian a few numbers that are blended like a
colour, and a linear classifier says which slot a pixel's blend is.

Rivals' heads on our model, not the paper's way: in Gaussian Grouping the classifier is learnt with the encoding.
"""

from __future__ import annotations

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
        return classes, self.classifier(encodings)

    def drawn_instances(self, outputs: torch.Tensor) -> torch.Tensor:
        """The encodings themselves, [N, E]."""
        return outputs

    def slot_logits(self, blended: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """What the classifier says of encodings [..., E] that were blended up to ``alpha`` [...]: [..., S]."""
        logits: torch.Tensor = self.classifier(blended / (alpha[..., None] + TINY))
        return logits

    def slot_coverage(self, blended: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """The coverage of the slots, [..., S], which sums to ``alpha``."""
        return torch.softmax(self.slot_logits(blended, alpha), dim=-1) * alpha[..., None]
