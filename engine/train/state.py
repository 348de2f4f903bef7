"""The whole state of a trainer as named tensors and JSON-ready facts: what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..model.growing import GrowthStatistics
from ..model.structured import from_tensors, to_tensors
from .trainer import Trainer


def trainer_state(trainer: Trainer) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Everything that ``restore`` needs to go on bit for bit."""
    model, facts = to_tensors(trainer.scene)
    tensors = {f"model.{name}": tensor for name, tensor in model.items()}
    tensors |= {f"optimiser.{name}": tensor for name, tensor in trainer.optimiser.tensors().items()}
    tensors |= {f"growth.{name}": tensor for name, tensor in trainer.statistics.tensors().items()}
    for number, target in enumerate(trainer.targets):
        if target.pseudo is not None:
            tensors[f"pseudo.{number}"] = target.pseudo
        if target.pseudo_slot is not None:
            tensors[f"pseudo_slot.{number}"] = target.pseudo_slot
    return tensors, {"step": trainer.step_number, "optimiser_steps": trainer.optimiser.count, "model": facts}


def restore(trainer: Trainer, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> None:
    """Put ``trainer`` (made for the same input, preset and seed) into a stored state."""
    trainer.scene = from_tensors(_under("model.", tensors), facts["model"])
    trainer.optimiser = trainer.optimiser.rebound(trainer.scene.anchors, trainer.scene.decoders)
    trainer.optimiser.restore(_under("optimiser.", tensors), facts["optimiser_steps"])
    growth = _under("growth.", tensors)
    trainer.statistics = GrowthStatistics(**{name: tensor.clone() for name, tensor in growth.items()})
    for number, target in enumerate(trainer.targets):
        pseudo, slot = (tensors.get(f"{name}.{number}") for name in ("pseudo", "pseudo_slot"))
        target.pseudo = None if pseudo is None else pseudo.clone()
        target.pseudo_slot = None if slot is None else slot.clone()
    trainer.step_number = facts["step"]
    trainer.follow_anchors()


def _under(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
