"""The decoders of a scene that was joined from blocks: each block has its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, ClassVar

import torch
from torch import nn

from .anchors import Anchors
from .decoders import DECODERS, Decoders, DecoderShape
from .gaussians import decode_rows
from .neural_gaussians import NeuralGaussians

MOST_BLOCKS = 1000
_PARTS = ("opacity", "covariance", "colour")


@dataclass(frozen=True)
class BlockShape(DecoderShape):
    """``anchors``: the number of the scene's anchors in each block. Those of the first block come first."""

    anchors: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.anchors, list):  # as read from JSON
            object.__setattr__(self, "anchors", tuple(self.anchors))

    @property
    def of_block(self) -> DecoderShape:
        """The shape of a block's decoders. They draw no labels, as labels were voted."""
        sizes = self.features, self.gaussians_per_anchor, 1, 1, self.distance_input, self.label_view_input
        return DecoderShape(*sizes)


class BlockDecoders(Decoders):
    """The opacity, covariance and colour decoders of each block. The labels of its Gaussians must be known."""

    kind: ClassVar[str] = "blocks"
    shape_type: ClassVar[type[DecoderShape]] = BlockShape

    def __init__(self, shape: BlockShape, seed: int) -> None:
        nn.Module.__init__(self)
        self.shape = shape
        self.of_block = [Decoders(shape.of_block, seed) for _ in shape.anchors]
        self.blocks = nn.ModuleList(self.of_block)
        for block in self.of_block:
            for part in (block.semantic, block.instance):
                part.requires_grad_(False)
                for weights in part.parameters():
                    nn.init.zeros_(weights)

    @classmethod
    def joined(cls, shape: BlockShape, decoders: list[Decoders]) -> BlockDecoders:
        """The decoders of the blocks, in order."""
        found = cls(shape, seed=0)
        for block, own in zip(found.of_block, decoders, strict=True):
            for part in _PARTS:
                getattr(block, part).load_state_dict(getattr(own, part).state_dict())
        return found

    @classmethod
    def weight_sizes(cls, shape: BlockShape) -> dict[str, tuple[int, ...]]:
        own = Decoders.weight_sizes(shape.of_block)
        return {f"blocks.{block}.{name}": size for block in range(len(shape.anchors)) for name, size in own.items()}

    @classmethod
    def check_shape(cls, shape: BlockShape) -> None:
        super().check_shape(shape)
        counts = shape.anchors
        if not isinstance(counts, tuple) or not 1 <= len(counts) <= MOST_BLOCKS:
            raise ValueError(f"the model's number of blocks is not between 1 and {MOST_BLOCKS}")
        if not all(type(count) is int and count >= 0 for count in counts):
            raise ValueError("the blocks' numbers of anchors are missing or invalid")

    @classmethod
    def check_anchors(cls, shape: BlockShape, anchors: int) -> None:
        if sum(shape.anchors) != anchors:
            raise ValueError("the blocks' numbers of anchors do not add up to the model's")

    def own_decoding(
        self,
        anchors: Anchors,
        visible: torch.Tensor,
        centre: torch.Tensor,
        channels: torch.Tensor | None,
        known_labels: torch.Tensor | None,
    ) -> NeuralGaussians:
        """Decode each block's anchors with its decoders. Raises ValueError without ``known_labels``."""
        if known_labels is None:
            raise ValueError("the labels of the blocks are not known")
        ends = torch.tensor([*accumulate(self.shape.anchors)])
        order = visible.sort().values
        parts = order.tensor_split(torch.searchsorted(order, ends[:-1]))
        decoded = [
            decode_rows(anchors, block, rows, centre, known_labels=known_labels)
            for block, rows in zip(self.of_block, parts, strict=True)
        ]
        return _joined(decoded, anchors.gaussians_per_anchor)


def _joined(parts: list[NeuralGaussians], k: int) -> NeuralGaussians:
    """The Gaussians of all parts, as if they had been decoded at once."""
    before = [0, *accumulate(len(part.visible) for part in parts)]
    shifted = [replace(part, kept=part.kept + k * start) for part, start in zip(parts, before, strict=False)]
    names = [name for name in vars(parts[0]) if name != "cluster_loss"]
    tensors: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in shifted]) for name in names}
    return NeuralGaussians(**tensors, cluster_loss=parts[0].cluster_loss)


DECODERS[BlockDecoders.kind] = BlockDecoders
