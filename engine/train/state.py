"""The whole state of a trainer as named tensors and JSON-ready facts: what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..model.growing import GrowthStatistics
from ..model.structured import from_tensors, to_tensors
from ..scene import Camera
from .targets import PseudoLabels
from .trainer import Trainer


def trainer_state(trainer: Trainer) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Everything that ``restore`` needs to go on bit for bit."""
    model, facts = to_tensors(trainer.scene)
    tensors = {f"model.{name}": tensor for name, tensor in model.items()}
    tensors |= {f"optimiser.{name}": tensor for name, tensor in trainer.optimiser.tensors().items()}
    tensors |= {f"growth.{name}": tensor for name, tensor in trainer.statistics.tensors().items()}
    for number, labels in enumerate(trainer.pseudo):
        if labels is not None:
            tensors[f"pseudo.{number}"] = _as_tensor(labels.classes)
            if labels.slots is not None:
                tensors[f"pseudo_slot.{number}"] = _as_tensor(labels.slots)
    return tensors, {"step": trainer.step_number, "optimiser_steps": trainer.optimiser.count, "model": facts}


def restore(trainer: Trainer, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> None:
    """Put ``trainer`` (made for the same input, preset and seed) into a stored state."""
    trainer.scene = from_tensors(_under("model.", tensors), facts["model"])
    trainer.optimiser = trainer.optimiser.rebound(trainer.scene.anchors, trainer.scene.decoders)
    trainer.optimiser.restore(_under("optimiser.", tensors), facts["optimiser_steps"])
    growth = _under("growth.", tensors)
    trainer.statistics = GrowthStatistics(**{name: tensor.clone() for name, tensor in growth.items()})
    trainer.pseudo = [_pseudo_labels(number, view.camera, tensors) for number, view in enumerate(trainer.views)]
    trainer.step_number = facts["step"]
    trainer.follow_anchors()


def _as_tensor(packed: bytes) -> torch.Tensor:
    return torch.frombuffer(bytearray(packed), dtype=torch.uint8)


def _pseudo_labels(number: int, camera: Camera, tensors: Mapping[str, torch.Tensor]) -> PseudoLabels | None:
    classes, slots = (tensors.get(f"{name}.{number}") for name in ("pseudo", "pseudo_slot"))
    if classes is None:
        return None
    shape = (camera.height, camera.width)
    return PseudoLabels(shape, classes.numpy().tobytes(), None if slots is None else slots.numpy().tobytes())


def _under(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
