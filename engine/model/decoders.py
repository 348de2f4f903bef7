"""The decoders F_alpha, F_sem, ... that turn an anchor's feature and where it is seen from into its Gaussians
(paper, equation "decoder")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

HIDDEN = 32
"""Width of the one hidden layer, Scaffold-GS's default."""


@dataclass(frozen=True)
class DecoderShape:
    """What the decoders look like.

    ``distance_input`` feeds the distance to the camera beside the direction, as the paper's formula has it;
    ``label_view_input`` feeds both to the label decoders too. Off, an object's label cannot depend on who looks at it.
    ``plain``: there are no decoders, see ``engine/model/plain.py``. ``encoding``: so many channels of an encoding take
    the place of the slots' probabilities, see ``engine/model/encoded.py``; 0 for none. ``twin``: encodings are given
    twice, the second time by a decoder that follows the first one slowly.
    """

    features: int
    gaussians_per_anchor: int
    classes: int
    instance_slots: int
    distance_input: bool
    label_view_input: bool
    plain: bool = False
    encoding: int = 0
    twin: bool = False

    @property
    def instance_outputs(self) -> int:
        """Of the instance decoder, for each Gaussian."""
        return self.encoding or self.instance_slots

    @property
    def instance_channels(self) -> int:
        """What is drawn of instances."""
        return 2 * self.encoding if self.twin else self.instance_outputs

    @property
    def view_inputs(self) -> int:
        return 4 if self.distance_input else 3


def _mlp(inputs: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    """One hidden layer with ReLU; weights drawn from ``generator`` alone, so that a seed means the same everywhere."""
    first, last = drawn_layer(inputs, HIDDEN, generator), drawn_layer(HIDDEN, outputs, generator)
    return nn.Sequential(first, nn.ReLU(), last)


def drawn_layer(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer whose weights are drawn from ``generator``."""
    layer = nn.Linear(inputs, outputs)
    bound = inputs**-0.5
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer


class Decoders(nn.Module):
    """Opacity, covariance, colour, semantic and instance decoders."""

    def __init__(self, shape: DecoderShape, seed: int) -> None:
        super().__init__()
        self.shape = shape
        generator = torch.Generator().manual_seed(seed)
        k, seen = shape.gaussians_per_anchor, shape.features + shape.view_inputs
        labelled = seen if shape.label_view_input else shape.features
        self.opacity = _mlp(seen, k, generator)
        self.covariance = _mlp(seen, 7 * k, generator)
        self.colour = _mlp(seen, 3 * k, generator)
        self.semantic = _mlp(labelled, shape.classes * k, generator)
        self.instance = _mlp(labelled, shape.instance_outputs * k, generator)

    def view_input(self, feature: torch.Tensor, position: torch.Tensor, camera_centre: torch.Tensor) -> torch.Tensor:
        """Features [V, F] with the direction (and distance in metres) from the camera appended: [V, F + 3 or 4]."""
        towards = position - camera_centre
        distance = towards.norm(dim=1, keepdim=True).clamp_min(1e-6)
        parts = [feature, towards / distance]
        if self.shape.distance_input:
            parts.append(distance)
        return torch.cat(parts, dim=1)

    def label_outputs(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What the semantic [V, k, C] and the instance decoder [V, k, S] give; ``seen`` is what ``view_input`` gave."""
        given = seen if self.shape.label_view_input else feature
        shape, count = self.shape, len(given)
        return (
            self.semantic(given).view(count, shape.gaussians_per_anchor, shape.classes),
            self.instance(given).view(count, shape.gaussians_per_anchor, shape.instance_outputs),
        )

    def label_logits(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Semantic [V, k, C] and instance [V, k, S] logits."""
        return self.label_outputs(feature, seen)

    def drawn_instances(self, outputs: torch.Tensor) -> torch.Tensor:
        """What is drawn of Gaussians [N, S] for which the instance decoder gave this: probabilities of the slots."""
        return torch.softmax(outputs, dim=1)
