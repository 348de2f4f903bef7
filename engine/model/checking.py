"""A model that comes from a file is checked before any kernel sees it: kernels do not look whether an index is one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch

from ..scene.classes import LARGEST_ID
from .decoders import HIDDEN, DecoderShape
from .plain import LABELS, LARGEST_LEVEL

MOST_ANCHORS = 20_000_000
MOST_LABELS = 64
"""Likeliest labels that a Gaussian keeps."""
FARTHEST = 1e6
"""Metres."""
LARGEST_LOG = 50.0
"""Of a scale in metres: its exponential is still a number of 32 bits."""
LARGEST_WEIGHT = 1e6
_SIZES = {"features": 512, "gaussians_per_anchor": 64, "classes": LARGEST_ID, "instance_slots": LARGEST_ID}
LARGEST_ENCODING = 256
"""Channels."""
_FLAGS = ("distance_input", "label_view_input", "plain", "twin")


class Wanted(NamedTuple):
    """What a tensor has to be; its numbers lie from ``least`` to ``most``."""

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32
    least: float = -math.inf
    most: float = math.inf


def check_tensors(tensors: Mapping[str, torch.Tensor], wanted: Mapping[str, Wanted]) -> None:
    """Raises ValueError unless these very tensors are there, each of its shape and type, of finite numbers in range."""
    odd = sorted(set(tensors) ^ set(wanted))
    if odd:
        raise ValueError(f"the tensor {odd[0]} is {'missing' if odd[0] in wanted else 'not known'}")
    for name, (shape, dtype, least, most) in wanted.items():
        tensor = tensors[name]
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise ValueError(f"{name} is {tensor.dtype} {list(tensor.shape)}, not {dtype} {list(shape)}")
        if tensor.numel():
            low, high = tensor.aminmax()  # NaN where one number is
            if not (math.isfinite(low) and math.isfinite(high) and least <= low and high <= most):
                raise ValueError(f"{name} holds numbers that it cannot hold")


def wanted_of_model(facts: Mapping[str, Any], anchors: int, labels: int | None) -> dict[str, Wanted]:
    """What ``from_tensors`` takes: of a model with so many ``anchors``, and ``labels`` voted onto each Gaussian (None:
    none). Raises ValueError when the facts do not fit together, or are too many.
    """
    classes, slots = _ids(facts, "class_ids", least=1), _ids(facts, "slot_ids", least=-1)
    owners = _ids(facts, "class_of_slot", least=0)
    shape = _shape(facts["decoders"], len(classes), len(slots))
    instances = [slot for slot, instance in enumerate(slots) if instance > 0]
    if classes != sorted(set(classes)) or len({slots[slot] for slot in instances}) < len(instances):
        raise ValueError("class ids or instance ids stand there twice")
    if owners and (len(owners) != len(slots) or not {owners[slot] for slot in instances} <= {*classes}):
        raise ValueError("class_of_slot does not fit the slots")
    if not 0 <= anchors <= MOST_ANCHORS:
        raise ValueError(f"there are {anchors} anchors, at most {MOST_ANCHORS} may be")
    k = shape.gaussians_per_anchor
    wanted = {
        "anchors.position": Wanted((anchors, 3), least=-FARTHEST, most=FARTHEST),
        "anchors.feature": Wanted((anchors, shape.features), least=-LARGEST_WEIGHT, most=LARGEST_WEIGHT),
        "anchors.offset": Wanted((anchors, k, 3), least=-LARGEST_WEIGHT, most=LARGEST_WEIGHT),
        "anchors.log_scale": Wanted((anchors, 6), least=-LARGEST_LOG, most=LARGEST_LOG),
        "anchors.level": Wanted((anchors,), torch.int64, 0, LARGEST_LEVEL),
        "anchors.initial_class": Wanted((anchors,), torch.int64, 0, LARGEST_ID),
        **_wanted_of_decoders(shape),
    }
    if labels is not None:
        if not 1 <= labels <= MOST_LABELS or (instances and not owners):
            raise ValueError("the voted labels do not fit")
        last = len(classes) + len(instances) - 1
        wanted["voted.label"] = Wanted((anchors * k, labels), torch.int16, 0, last)
        wanted["voted.share"] = Wanted((anchors * k, labels), least=0.0, most=1.001)
    return wanted


def check_model(tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> None:
    """Raises ValueError unless ``from_tensors`` can make a scene of these, and kernels can draw it."""
    voxel_size = facts["voxel_size"]
    if not isinstance(voxel_size, float | int) or not 1e-4 <= voxel_size <= 100:
        raise ValueError("voxel_size is no length of a voxel")
    anchors = tensors["anchors.position"].shape[:1]
    labels = tensors["voted.label"].shape[-1:] if "voted.label" in tensors else None
    if not anchors or labels == ():
        raise ValueError("a tensor has no rows")
    check_tensors(tensors, wanted_of_model(facts, anchors[0], None if labels is None else labels[0]))


def _wanted_of_decoders(shape: DecoderShape) -> dict[str, Wanted]:
    if shape.plain:
        return {}
    k, seen = shape.gaussians_per_anchor, shape.features + shape.view_inputs
    labelled = seen if shape.label_view_input else shape.features
    sides = {
        "opacity": (seen, k),
        "covariance": (seen, 7 * k),
        "colour": (seen, 3 * k),
        "semantic": (labelled, shape.classes * k),
        "instance": (labelled, shape.instance_outputs * k),
    }
    if shape.twin:
        sides["slow"] = sides["instance"]
    layers = {
        f"decoders.{name}.{layer}.{part}": size
        for name, (inputs, outputs) in sides.items()
        for layer, part, size in (
            (0, "weight", (HIDDEN, inputs)),
            (0, "bias", (HIDDEN,)),
            (2, "weight", (outputs, HIDDEN)),
            (2, "bias", (outputs,)),
        )
    }
    if shape.encoding:
        layers["decoders.classifier.weight"] = (shape.instance_slots, shape.encoding)
        layers["decoders.classifier.bias"] = (shape.instance_slots,)
    return {name: Wanted(size, least=-LARGEST_WEIGHT, most=LARGEST_WEIGHT) for name, size in layers.items()}


def _shape(facts: Mapping[str, Any], classes: int, slots: int) -> DecoderShape:
    facts = {"plain": False, "encoding": 0, "twin": False, **facts}  # models of before have none
    if set(facts) != {*_SIZES, *_FLAGS, "encoding"}:
        raise ValueError("the decoders' shape is not known")
    is_plain = facts["plain"] is True
    if is_plain and (facts["gaussians_per_anchor"], facts["features"]) != (1, LABELS + classes + slots):
        raise ValueError("the columns of plain Gaussians do not fit their labels")
    for name, most in _SIZES.items():
        if name == "features" and is_plain:
            continue
        if type(facts[name]) is not int or not 1 <= facts[name] <= most:
            raise ValueError(f"{name} of the decoders is no number from 1 to {most}")
    encoding = facts["encoding"]
    if type(encoding) is not int or not 0 <= encoding <= LARGEST_ENCODING:
        raise ValueError(f"the encoding is no number of channels from 0 to {LARGEST_ENCODING}")
    if encoding and (is_plain or facts["label_view_input"]):
        raise ValueError("an encoding is the same from everywhere, and of a decoder")
    if facts["twin"] and not encoding:
        raise ValueError("there is a twin, and no encoding")
    if not all(type(facts[name]) is bool for name in _FLAGS):
        raise ValueError("an input of the decoders is neither on nor off")
    if (facts["classes"], facts["instance_slots"]) != (classes, slots):
        raise ValueError("the decoders have other labels than the model")
    return DecoderShape(**facts)


def _ids(facts: Mapping[str, Any], name: str, least: int) -> list[int]:
    ids = facts[name]
    if not isinstance(ids, Sequence) or not all(type(one) is int and least <= one <= LARGEST_ID for one in ids):
        raise ValueError(f"{name} is no list of ids")
    return list(ids)
