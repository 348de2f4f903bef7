"""The structured, panoptic-aware scene: anchors, decoders, and the meaning of its label channels."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import torch

from .anchors import Anchors
from .checking import check_model, decoders_of
from .decoders import Decoders

FORMAT = 2
"""Format of model.safetensors. Format 1 had no slot for "no object"."""
NO_OBJECT, SPARE = 0, -1
"""Ids of slots without an instance: the slot of "no object", which is learnt like any object, and those of the paper's
25 slots for which no instance was found."""


@dataclass(frozen=True)
class LabelChannels:
    """What the label channels mean. ``class_ids``: the class of each semantic channel, ascending. ``slot_ids``: for
    each slot an instance id, ``NO_OBJECT``, or ``SPARE`` (trained, but never shown). ``class_of_slot``: the class of
    each slot's instance (0 for other slots) if each instance has one class; empty if its pixels may differ in class."""

    class_ids: tuple[int, ...]
    slot_ids: tuple[int, ...]
    class_of_slot: tuple[int, ...] = ()

    @property
    def instance_slots(self) -> tuple[int, ...]:
        """The indices of the slots that stand for instances."""
        return tuple(slot for slot, instance in enumerate(self.slot_ids) if instance > 0)

    @property
    def shown_ids(self) -> tuple[int, ...]:
        """The instance ids of ``instance_slots``, in their order."""
        return tuple(self.slot_ids[slot] for slot in self.instance_slots)

    @property
    def class_of_shown(self) -> dict[int, int]:
        """The class of each of the ``shown_ids``; empty if ``class_of_slot`` is."""
        return {self.slot_ids[slot]: self.class_of_slot[slot] for slot in self.instance_slots if self.class_of_slot}


@dataclass(frozen=True, eq=False)
class GaussianLabels:
    """The labels voted for each of G Gaussians, the K likeliest, likeliest first. ``label`` int16 [G, K]: 0 to C - 1
    are classes without an object, C and above the ``shown_ids`` in their order. ``share`` float32 [G, K]: the labels'
    shares of the votes, which sum to at most 1."""

    label: torch.Tensor
    share: torch.Tensor


@dataclass(frozen=True, eq=False)
class SceneFill:
    """Gaussians that fill the place of removed objects, float32: ``means`` [P, 3] metres, ``scales`` [P, 3], ``quats``
    [P, 4] wxyz, ``opacities`` [P], ``colours`` [P, 3]; ``guessed`` [P]: 1 where no photo saw the place. ``gone`` bool
    [G]: the scene's own Gaussians that are no longer drawn."""

    gone: torch.Tensor
    means: torch.Tensor
    scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor
    guessed: torch.Tensor

    def on(self, device: torch.device | str) -> SceneFill:
        """Return a copy on ``device``."""
        return SceneFill(*(each.to(device) for each in vars(self).values()))


@dataclass
class StructuredScene:
    """A scene, finished or in training. ``voxel_size``: metres. ``voted``: the Gaussians' labels, which replace those
    of the label decoders (None: not voted); anchor i has rows i k to i k + k - 1. ``finest`` float32 [M]: the side, in
    metres, of the smallest pixel that a training picture has at each anchor, 0 if it is in none; None if unknown.
    ``fill``: what replaces removed objects, whose labels follow the other Gaussians' in ``voted``; it is not in the
    model's file."""

    anchors: Anchors
    decoders: Decoders
    channels: LabelChannels
    voxel_size: float
    voted: GaussianLabels | None = None
    finest: torch.Tensor | None = None
    fill: SceneFill | None = None

    def on(self, device: torch.device | str) -> StructuredScene:
        """Return a copy of the scene on ``device``; the scene itself for the CPU."""
        if torch.device(device).type == "cpu":
            return self
        voted = None if self.voted is None else GaussianLabels(*(each.to(device) for each in vars(self.voted).values()))
        finest, decoders = None if self.finest is None else self.finest.to(device), deepcopy(self.decoders).to(device)
        fill = None if self.fill is None else self.fill.on(device)
        return replace(self, anchors=self.anchors.on(device), decoders=decoders, voted=voted, finest=finest, fill=fill)


def to_tensors(scene: StructuredScene) -> tuple[dict[str, torch.Tensor], dict[str, object]]:
    """Return the scene's tensors by name, and JSON facts, of which `from_tensors` makes the same scene again."""
    tensors = {f"anchors.{name}": tensor for name, tensor in scene.anchors.tensors().items()}
    tensors |= {f"decoders.{name}": tensor.detach() for name, tensor in scene.decoders.state_dict().items()}
    if scene.voted is not None:
        tensors |= {"voted.label": scene.voted.label, "voted.share": scene.voted.share}
    if scene.finest is not None:
        tensors["finest"] = scene.finest
    facts: dict[str, object] = {
        "format": FORMAT,
        "voxel_size": scene.voxel_size,
        "class_ids": list(scene.channels.class_ids),
        "slot_ids": list(scene.channels.slot_ids),
        "class_of_slot": list(scene.channels.class_of_slot),
        "decoders": scene.decoders.facts,
    }
    return tensors, facts


def from_tensors(tensors: dict[str, torch.Tensor], facts: dict) -> StructuredScene:
    """Restore a scene from what ``to_tensors`` returned. Raises ValueError for an unknown format and for parts that do
    not fit together, KeyError and TypeError for facts that are missing or of the wrong type."""
    if facts.get("format") != FORMAT:
        raise ValueError(f"model format {facts.get('format')!r} is not known to this version; lift again or update")
    check_model(tensors, facts)
    anchors = Anchors(**{name: tensors[f"anchors.{name}"].clone() for name in (*Anchors.LEARNT, *Anchors.FIXED)})
    kind, shape = decoders_of(facts["decoders"])
    decoders = kind(shape, seed=0)
    weights = {name: tensor for name, tensor in tensors.items() if name.startswith("decoders.")}
    decoders.load_state_dict({name.removeprefix("decoders."): tensor for name, tensor in weights.items()})
    meaning = (tuple(facts[name]) for name in ("class_ids", "slot_ids", "class_of_slot"))
    voted = GaussianLabels(tensors["voted.label"], tensors["voted.share"]) if "voted.label" in tensors else None
    channels, finest = LabelChannels(*meaning), tensors.get("finest")
    return StructuredScene(anchors, decoders, channels, float(facts["voxel_size"]), voted, finest)
