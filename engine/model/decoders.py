"""The decoders F_alpha, F_sem, ..., networks that turn an anchor's feature and the viewpoint into its Gaussians (see
the paper's equation "decoder")."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import ClassVar

import torch
from torch import nn
from torch.nn import functional

from ..presets.parts import Parts
from .anchors import AnchorsInView
from .neural_gaussians import NeuralGaussians

HIDDEN = 32
"""Width of the only hidden layer, Scaffold-GS's default."""
MOST_FEATURES = 512
"""The most entries of an anchor's feature in a model's file."""


@dataclass(frozen=True)
class DecoderShape:
    """Sizes and inputs of the decoders. All get the feature and the direction from the camera; ``distance_input`` adds
    the distance, as in the paper's formula. Label decoders get direction and distance only with ``label_view_input``:
    without it, an object's label cannot depend on the view."""

    features: int
    gaussians_per_anchor: int
    classes: int
    instance_slots: int
    distance_input: bool
    label_view_input: bool

    @property
    def view_inputs(self) -> int:
        return 4 if self.distance_input else 3


def run_side_by_side(
    given: torch.Tensor,  # [V, inputs]
    *networks: nn.Sequential,
) -> list[torch.Tensor]:
    """Return each network's output, [V, its outputs], for the same input. All first layers are computed by one matrix
    product, which is faster than a narrow product for each."""
    first, last = [network.get_submodule("0") for network in networks], [network[2] for network in networks]
    weight, bias = (torch.cat([layer.get_parameter(name) for layer in first]) for name in ("weight", "bias"))
    hidden = functional.linear(given, weight, bias).relu_().split(HIDDEN, dim=1)
    return [layer(inputs) for layer, inputs in zip(last, hidden, strict=True)]


def drawn_layer(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """Return a linear layer of these numbers of inputs and outputs, with random weights from ``generator``."""
    layer = nn.Linear(inputs, outputs)
    bound = inputs**-0.5  # as nn.Linear draws its own
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer


class Decoders(nn.Module):
    """The paper's opacity, covariance, colour, semantic and instance decoders, of the sizes ``shape``. Other kinds are
    subclasses with another ``kind``, made available by ``register_head``."""

    kind: ClassVar[str] = "structured"
    shape: DecoderShape

    def __init__(self, shape: DecoderShape, seed: int) -> None:
        super().__init__()
        self.shape = shape
        generator = torch.Generator().manual_seed(seed)
        # Weights are drawn only from the generator, so that a seed means the same everywhere.
        mlps = [
            nn.Sequential(drawn_layer(inputs, HIDDEN, generator), nn.ReLU(), drawn_layer(HIDDEN, outputs, generator))
            for inputs, outputs in self.sides(shape).values()
        ]
        self.opacity, self.covariance, self.colour, self.semantic, self.instance = mlps

    @classmethod
    def sides(cls, shape: DecoderShape) -> dict[str, tuple[int, int]]:
        """Return the number of inputs and of outputs of each decoder, by name."""
        k, seen = shape.gaussians_per_anchor, shape.features + shape.view_inputs
        labelled = seen if shape.label_view_input else shape.features
        return {
            "opacity": (seen, k),
            "covariance": (seen, 7 * k),
            "colour": (seen, 3 * k),
            "semantic": (labelled, shape.classes * k),
            "instance": (labelled, shape.instance_slots * k),
        }

    @classmethod
    def weight_sizes(cls, shape: DecoderShape) -> dict[str, tuple[int, ...]]:
        """Return the shape of each parameter, by its name in the state dict."""
        return {
            f"{name}.{layer}.{part}": size
            for name, (inputs, outputs) in cls.sides(shape).items()
            for layer, part, size in (
                (0, "weight", (HIDDEN, inputs)),
                (0, "bias", (HIDDEN,)),
                (2, "weight", (outputs, HIDDEN)),
                (2, "bias", (outputs,)),
            )
        }

    @classmethod
    def check_shape(cls, shape: DecoderShape) -> None:
        """Raise ValueError if decoders of this kind cannot have ``shape``."""
        if not 1 <= shape.features <= MOST_FEATURES:
            raise ValueError(f"features of the decoders is not a number between 1 and {MOST_FEATURES}")

    @property
    def facts(self) -> dict[str, object]:
        """The shape and the kind as JSON values, for the model's file."""
        kind = {} if self.kind == Decoders.kind else {"kind": self.kind}
        return {**asdict(self.shape), **kind}

    def learnt(self) -> Iterator[tuple[str, list[nn.Parameter]]]:
        """Yield the name of each learning rate with the parameters that it applies to."""
        for name, network in self.named_children():
            parameters = [each for each in network.parameters() if each.requires_grad]
            if parameters:
                yield name, parameters

    def view_input(
        self,
        feature: torch.Tensor,  # [V, F]
        position: torch.Tensor,  # [V, 3], metres
        camera_centre: torch.Tensor,  # [3], metres
    ) -> torch.Tensor:
        """Return ``feature`` with the direction (and distance) from the camera to ``position``: [V, F + 3 or F + 4]."""
        towards = position - camera_centre
        distance = towards.norm(dim=1, keepdim=True).clamp_min(1e-6)
        parts = [feature, towards / distance]
        if self.shape.distance_input:
            parts.append(distance)
        return torch.cat(parts, dim=1)

    def label_logits(
        self,
        feature: torch.Tensor,  # [V, F]
        seen: torch.Tensor,  # [V, F + 3 or 4], of ``view_input``
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the semantic logits [V, k, C] and the instance logits [V, k, S] of the anchors' Gaussians."""
        given = seen if self.shape.label_view_input else feature
        shape, count = self.shape, len(given)
        semantic, instance = run_side_by_side(given, self.semantic, self.instance)
        return (
            semantic.view(count, shape.gaussians_per_anchor, shape.classes),
            instance.view(count, shape.gaussians_per_anchor, shape.instance_slots),
        )

    decodes_all_anchors: ClassVar[bool] = False
    """Whether all anchors are decoded; otherwise only those whose position the camera sees."""

    def own_decoding(self, given: AnchorsInView) -> NeuralGaussians | None:
        """Return the decoded Gaussians, in kinds of decoders with a decoding of their own; None in all others."""
        return None


DECODERS: Parts[type[Decoders]] = Parts("head", {Decoders.kind: Decoders})
"""The kinds of decoders that a preset (``head``) and a model's file may name."""


def register_head(kind: type[Decoders]) -> None:
    """Make a kind of decoders available in this process, as its ``kind``. Programs that read its lifts need it, too."""
    DECODERS.register(kind.kind, kind)
