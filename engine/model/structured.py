"""The structured, panoptic-aware scene: anchors, decoders, and what their label channels mean."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch

from .anchors import Anchors
from .decoders import Decoders, DecoderShape


@dataclass(frozen=True)
class LabelChannels:
    """Meaning of the label channels: class id of each semantic channel, instance id of each slot (0 = spare slot).

    Spare slots take part in training, as in the paper's 25, but are never shown.
    """

    class_ids: tuple[int, ...]
    slot_ids: tuple[int, ...]


@dataclass
class StructuredScene:
    """A lifted (or half lifted) scene. ``voxel_size`` in metres."""

    anchors: Anchors
    decoders: Decoders
    channels: LabelChannels
    voxel_size: float


def to_tensors(scene: StructuredScene) -> tuple[dict[str, torch.Tensor], dict[str, object]]:
    """Named tensors and JSON-ready facts that ``from_tensors`` makes the scene from again."""
    tensors = {f"anchors.{name}": tensor for name, tensor in scene.anchors.tensors().items()}
    tensors |= {f"decoders.{name}": tensor.detach() for name, tensor in scene.decoders.state_dict().items()}
    facts: dict[str, object] = {
        "format": 1,
        "voxel_size": scene.voxel_size,
        "class_ids": list(scene.channels.class_ids),
        "slot_ids": list(scene.channels.slot_ids),
        "decoders": asdict(scene.decoders.shape),
    }
    return tensors, facts


def from_tensors(tensors: dict[str, torch.Tensor], facts: dict) -> StructuredScene:
    """The inverse of ``to_tensors``. Raises ValueError for a format this version does not know."""
    if facts.get("format") != 1:
        raise ValueError(f"model format {facts.get('format')!r} is not known to this version; lift again or update")
    anchors = Anchors(**{name: tensors[f"anchors.{name}"].clone() for name in (*Anchors.LEARNT, *Anchors.FIXED)})
    decoders = Decoders(DecoderShape(**facts["decoders"]), seed=0)
    weights = {name: tensor for name, tensor in tensors.items() if name.startswith("decoders.")}
    decoders.load_state_dict({name.removeprefix("decoders."): tensor for name, tensor in weights.items()})
    channels = LabelChannels(tuple(facts["class_ids"]), tuple(facts["slot_ids"]))
    return StructuredScene(anchors, decoders, channels, float(facts["voxel_size"]))
