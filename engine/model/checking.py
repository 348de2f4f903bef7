"""Validates a model that was read from a file, since the kernels do not check indices."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open

from ..gates import refuse_special
from ..job.system import main_memory
from ..posed.classes import LARGEST_ID
from .decoders import DECODERS, Decoders, DecoderShape

MOST_ANCHORS = 20_000_000
MOST_LABELS = 64
"""The most labels that a Gaussian keeps."""
FARTHEST = 1e6
"""The greatest distance of an anchor from the origin, in metres along each axis."""
LARGEST_LOG = 50.0
"""The largest logarithm of a scale in metres. Its exponential is still a finite float32."""
LARGEST_WEIGHT = 1e6
LARGEST_LEVEL = 63
"""The largest level of an anchor. Growth makes 1 to 3; in the baseline 3DGS it counts generations of growth."""
MOST_PER_ANCHOR = 64
"""The most Gaussians of an anchor."""


class Wanted(NamedTuple):
    """What a tensor of the file must have: shape, dtype, and values from ``least`` to ``most``."""

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32
    least: float = -math.inf
    most: float = math.inf


def check_tensors(tensors: Mapping[str, torch.Tensor], wanted: Mapping[str, Wanted]) -> None:
    """Raise ValueError unless there are exactly the tensors ``wanted`` (by name), with finite values in range."""
    odd = sorted(set(tensors) ^ set(wanted))
    if odd:
        raise ValueError(f"the tensor {odd[0]} is {'missing' if odd[0] in wanted else 'not known'}")
    for name, (shape, dtype, least, most) in wanted.items():
        tensor = tensors[name]
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise ValueError(f"{name} is {tensor.dtype} {list(tensor.shape)}, not {dtype} {list(shape)}")
        if tensor.numel():
            low, high = tensor.aminmax()  # NaN if any number is
            if not (math.isfinite(low) and math.isfinite(high) and least <= low and high <= most):
                raise ValueError(f"{name} holds numbers outside its range")


def wanted_of_model(facts: Mapping[str, Any], anchors: int, labels: int | None) -> dict[str, Wanted]:
    """Return what each tensor of a model must be, by name, given its ``facts``, number of ``anchors``, and number of
    ``labels`` voted per Gaussian (None: not voted). Raises ValueError if the facts do not fit together."""
    classes, slots = _ids(facts, "class_ids", least=1), _ids(facts, "slot_ids", least=-1)
    owners = _ids(facts, "class_of_slot", least=0)
    kind, shape = decoders_of(facts["decoders"])
    if (shape.classes, shape.instance_slots) != (len(classes), len(slots)):
        raise ValueError("the decoders' labels are not those of the model")
    instances = [slot for slot, instance in enumerate(slots) if instance > 0]
    if classes != sorted(set(classes)) or len({slots[slot] for slot in instances}) < len(instances):
        raise ValueError("class ids or instance ids are not unique")
    if owners and (len(owners) != len(slots) or not {owners[slot] for slot in instances} <= {*classes}):
        raise ValueError("class_of_slot does not fit the slots")
    if not 0 <= anchors <= MOST_ANCHORS:
        raise ValueError(f"there are {anchors} anchors, but at most {MOST_ANCHORS} are allowed")
    k = shape.gaussians_per_anchor
    wanted = {
        "anchors.position": Wanted((anchors, 3), least=-FARTHEST, most=FARTHEST),
        "anchors.feature": Wanted((anchors, shape.features), least=-LARGEST_WEIGHT, most=LARGEST_WEIGHT),
        "anchors.offset": Wanted((anchors, k, 3), least=-LARGEST_WEIGHT, most=LARGEST_WEIGHT),
        "anchors.log_scale": Wanted((anchors, 6), least=-LARGEST_LOG, most=LARGEST_LOG),
        "anchors.level": Wanted((anchors,), torch.int64, 0, LARGEST_LEVEL),
        "anchors.initial_class": Wanted((anchors,), torch.int64, 0, LARGEST_ID),
    }
    for name, size in kind.weight_sizes(shape).items():
        wanted[f"decoders.{name}"] = Wanted(size, least=-LARGEST_WEIGHT, most=LARGEST_WEIGHT)
    if labels is not None:
        if not 1 <= labels <= MOST_LABELS or (instances and not owners):
            raise ValueError("the voted labels do not fit")
        last = len(classes) + len(instances) - 1
        wanted["voted.label"] = Wanted((anchors * k, labels), torch.int16, 0, last)
        wanted["voted.share"] = Wanted((anchors * k, labels), least=0.0, most=1.001)  # float32 sums are not exact
    return wanted


def check_model(tensors: Mapping[str, torch.Tensor], facts: Mapping[str, Any]) -> None:
    """Raise ValueError unless ``from_tensors`` can make a scene from these arguments that kernels can draw."""
    voxel_size = facts["voxel_size"]
    if not isinstance(voxel_size, float | int) or not 1e-4 <= voxel_size <= 100:
        raise ValueError("voxel_size is not a valid length")
    anchors = tensors["anchors.position"].shape[:1]
    labels = tensors["voted.label"].shape[-1:] if "voted.label" in tensors else None
    if not anchors or labels == ():
        raise ValueError("a tensor has no rows")
    wanted = wanted_of_model(facts, anchors[0], None if labels is None else labels[0])
    if "finest" in tensors:  # earlier versions did not write it
        wanted["finest"] = Wanted((anchors[0],), least=0.0, most=FARTHEST)
    check_tensors(tensors, wanted)


def decoders_of(facts: Mapping[str, Any]) -> tuple[type[Decoders], DecoderShape]:
    """Return the class of decoders that a file's facts name, and their shape. Raises ValueError for unknown ones."""
    kind = DECODERS.get(facts.get("kind", Decoders.kind))
    known = {name: value for name, value in facts.items() if name != "kind"}
    if kind is None or set(known) != {each.name for each in fields(DecoderShape)}:
        raise ValueError("the decoders' shape is unknown: only the script or the baseline that made them can read them")
    for each in fields(DecoderShape):
        value = known[each.name]
        if each.type == "bool" and type(value) is not bool:
            raise ValueError(f"{each.name} of the decoders is neither on nor off")
        if each.type == "int" and (type(value) is not int or value < 1):
            raise ValueError(f"{each.name} of the decoders is not a positive integer")
    shape = DecoderShape(**known)
    if shape.gaussians_per_anchor > MOST_PER_ANCHOR or max(shape.classes, shape.instance_slots) > LARGEST_ID:
        raise ValueError("the decoders have too many Gaussians or labels")
    kind.check_shape(shape)
    return kind, shape


def _ids(facts: Mapping[str, Any], name: str, least: int) -> list[int]:
    ids = facts[name]
    if not isinstance(ids, Sequence) or not all(type(one) is int and least <= one <= LARGEST_ID for one in ids):
        raise ValueError(f"{name} is not a list of ids")
    return list(ids)


# Tensors from a .safetensors file of unknown origin.

MOST_BYTES = 1 << 35
"""Upper limit for a model (see `checking`) or a checkpoint, in bytes."""


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Read a safetensors file: tensors by name, and the header's notes. Raises OSError, and ValueError if the file is
    damaged or larger than memory. safetensors checks that the file is complete, so reading takes no more memory than
    its length; but a sparse file may be longer than its space on disk."""
    refuse_special(path)
    size, memory = path.stat().st_size, main_memory()
    if size > MOST_BYTES or (memory is not None and size > memory.free):
        raise ValueError(f"it needs {size / 1e9:.1f} GB of memory, which is more than there is")
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(str(error)) from error
    except (MemoryError, RuntimeError) as error:  # torch's allocator has no error class of its own
        raise ValueError(f"no memory is left for {size / 1e9:.1f} GB") from error
