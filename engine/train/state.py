"""Saves and restores the complete state of a trainer, as named tensors and JSON values: the content of a checkpoint."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any

import torch

from ..model.checking import Wanted, check_tensors
from ..model.growing import GrowthStatistics
from ..model.structured import StructuredScene, from_tensors, to_tensors
from .optimiser import Optimiser
from .self_training import PseudoLabels
from .trainer import Trainer


class OtherLabels(ValueError):
    """Raised by ``restore`` if the state has other classes or objects than the masks give now."""


def trainer_state(trainer: Trainer) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the tensors by name, and other facts (JSON), from which ``restore`` continues bit for bit."""
    model, facts = to_tensors(trainer.scene)
    tensors = {f"model.{name}": tensor for name, tensor in model.items()}
    if trainer.step_number < trainer.preset.steps:  # else no step follows; the moments are two thirds of a checkpoint
        tensors |= {f"optimiser.{name}": tensor for name, tensor in trainer.optimiser.tensors().items()}
    tensors |= {f"growth.{name}": tensor for name, tensor in trainer.statistics.tensors().items()}
    for number, labels in enumerate(trainer.pseudo):
        if labels is not None:
            tensors[f"pseudo.{number}"] = _as_tensor(labels.classes)
            if labels.slots is not None:
                tensors[f"pseudo_slot.{number}"] = _as_tensor(labels.slots)
    return tensors, {"step": trainer.step_number, "optimiser_steps": trainer.optimiser.count, "model": facts}


def restore(trainer: Trainer, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> None:
    """Restore a state (the ``tensors`` and ``facts`` of `trainer_state`) into ``trainer``, which was made for the same
    input, preset and seed. Raises ValueError, KeyError or TypeError for a damaged state or one of another lift, and
    leaves the trainer unchanged."""
    scene = from_tensors(_under("model.", tensors), facts["model"])
    _check(trainer, scene, tensors, facts)
    trainer.scene = scene
    before = trainer.optimiser
    trainer.optimiser = Optimiser(scene.anchors, scene.decoders, before.rates, before.extent)
    trainer.optimiser.restore(_under("optimiser.", tensors), facts["optimiser_steps"])
    growth = _under("growth.", tensors)
    trainer.statistics = GrowthStatistics(**{name: tensor.clone() for name, tensor in growth.items()})
    packed = {name: tensor.numpy().tobytes() for name, tensor in tensors.items() if name.startswith("pseudo")}
    for number, view in enumerate(trainer.views):
        shape, classes = (view.camera.height, view.camera.width), packed.get(f"pseudo.{number}")
        slots = packed.get(f"pseudo_slot.{number}")
        trainer.pseudo[number] = None if classes is None else PseudoLabels(shape, classes, slots)
    trainer.step_number = facts["step"]
    trainer.follow_anchors()


def _check(
    trainer: Trainer, scene: StructuredScene, tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]
) -> None:
    """Raise ValueError unless the state's other parts (all but the model ``scene``) fit the trainer as well."""
    if (scene.channels, scene.decoders.shape) != (trainer.scene.channels, trainer.scene.decoders.shape):
        raise OtherLabels("it belongs to a lift with other labels")
    if type(facts["step"]) is not int or not 0 <= facts["step"] <= trainer.preset.steps:  # isinstance would take True
        raise ValueError("its step number is not one of this lift's")
    if type(facts["optimiser_steps"]) is not int or facts["optimiser_steps"] < 0:
        raise ValueError("its optimiser's number of steps is not valid")
    parameters = {f"anchors.{name}": getattr(scene.anchors, name) for name in scene.anchors.LEARNT}
    learnt = {name: each for name, each in scene.decoders.named_parameters() if each.requires_grad}
    parameters |= {f"decoders.{name}": parameter for name, parameter in learnt.items()}
    moments, growth = _under("optimiser.", tensors), _under("growth.", tensors)
    wanted = {
        f"{name}.{moment}": Wanted(tuple(parameter.shape), least=-math.inf if moment == "mean" else 0.0)
        for name, parameter in parameters.items()
        for moment in ("mean", "square")
    }
    check_tensors(moments, wanted if moments else {})  # a finished lift's checkpoint has no moments
    empty = GrowthStatistics.empty(scene.anchors).tensors()
    check_tensors(growth, {name: Wanted(tuple(tensor.shape), least=0.0) for name, tensor in empty.items()})
    for prefix, channels in (("pseudo.", scene.channels.class_ids), ("pseudo_slot.", scene.channels.slot_ids)):
        for number, packed in _under(prefix, tensors).items():
            if number not in {str(view) for view in range(len(trainer.views))}:
                raise ValueError(f"its pseudo labels are of view {number}, which this lift does not have")
            camera = trainer.views[int(number)].camera
            expected = 2 * camera.height * camera.width  # bytes of int16
            try:
                numbers = zlib.decompressobj().decompress(packed.numpy().tobytes(), expected + 1)  # one more shows
            except zlib.error as error:
                raise ValueError(f"its pseudo labels are damaged ({error})") from None
            if packed.dtype != torch.uint8 or len(numbers) != expected:
                raise ValueError("its pseudo labels have a different size")
            labels = torch.frombuffer(bytearray(numbers), dtype=torch.int16)
            if int(labels.min()) < -1 or int(labels.max()) >= len(channels):
                raise ValueError("its pseudo labels are not channels of the model")


def _as_tensor(packed: bytes) -> torch.Tensor:
    return torch.frombuffer(bytearray(packed), dtype=torch.uint8)


def _under(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
