"""The choices of the presets as a table by name, and a preset with some of them changed.

``engine/job/preset_options.json`` is this table, for where there is no torch.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from ..job import LiftRequest
from .presets import PRESETS, Preset, chosen_preset

SIDES = (16, 16384)
"""Pixels of a picture's side, as in a request."""
TINY = 1e-9
"""The least value of what has to be more than zero."""
SHARE = (0.0, 1.0)
LEVELS = 3
"""Of growth: the lists of its rules have a number each."""
RANGES: dict[str, tuple[float, float | None]] = {
    "steps": (1, 10_000_000),
    "size_within": SIDES,
    "most_frames": (0, 1_000_000),
    "voxel_size": (0.001, 10.0),
    "gaussians_per_anchor": (1, 32),
    "features": (5, 128),
    "instance_slots": (0, 1000),
    "most_anchors": (1, None),
    "most_points": (1, None),
    "neighbours": (0, 64),
    "agreement": (TINY, 1.0),
    "majority": SHARE,
    "most_instances": (1, 4000),
    "matching.tau_new": (-2.0, 0.0),
    "schedule.self_training_every": (0.001, 1.0),
    "schedule.statistics_from": SHARE,
    "schedule.grow_from": SHARE,
    "schedule.grow_until": SHARE,
    "schedule.grow_every": (TINY, 1.0),
    "schedule.grow_every_at_least_steps": (1, None),
    "schedule.segments_from": SHARE,
    "warm_start.batch": (1, None),
    "warm_start.rate": (TINY, None),
    "warm_start.opacity_bias": (-3.0, 3.0),
    "vote_size_within": SIDES,
    "vote_rounds": (1, 10),
    "label_every": (1, None),
    "voting.contributors": (1, 16),
    "voting.kept": (1, 64),
    "plain.opacity": SHARE,
    "plain.reset_share": (TINY, 1.0),
    "plain.reset_to": (TINY, 0.99),
    "plain.reset_steps": (1, None),
    "consensus.support": SHARE,
    "identity.channels": (1, 64),
    "identity.neighbours": (1, 64),
    "identity.samples": (1, 100_000),
    "identity.every": (1, None),
    "contrastive.channels": (1, 64),
    "contrastive.momentum": SHARE,
    "contrastive.pixels": (2, 20_000),
    "contrastive.clustered": (2, 20_000),
    "contrastive.least_share": SHARE,
}
"""Least and greatest value; of what is not named here, 0 and any, and of the learning rates more than 0."""


@dataclass(frozen=True)
class _Field:
    """A leaf of the presets' dataclasses: its dotted name and its type; ``part``: that it is an optional group."""

    name: str
    type: Any
    part: bool = False


def options_of_presets() -> list[dict[str, object]]:
    """The table: an object an option, as ``PresetOption`` has it."""
    leaves = [leaf for leaf in _leaves(Preset) if leaf.name != "name"]
    values = {name: asdict(preset) for name, preset in PRESETS.items()}
    return [_entry(leaf, {name: _value_of(tree, leaf) for name, tree in values.items()}) for leaf in leaves]


def table_text() -> str:
    """preset_options.json: a line an option."""
    rows = ",\n".join(json.dumps(entry) for entry in options_of_presets())
    return f"[\n{rows}\n]\n"


def requested_preset(request: LiftRequest) -> Preset:
    """The preset that a lift was asked for, with the steps, size, frames and options of the request."""
    return with_options(chosen_preset(request.preset, request.steps, request.size, request.frames), request.options)


def with_options(preset: Preset, options: Mapping[str, object]) -> Preset:
    """The preset with these options, as ``checked_options`` gives them. Raises KeyError for a name that is none, and
    ValueError for values that do not go together."""
    for name, value in options.items():
        preset = _with(preset, name.split("."), value)
    return preset


def _with(part: Any, names: list[str], value: object) -> Any:
    first, *rest = names
    kind = get_type_hints(type(part))[first]
    now = getattr(part, first)
    if rest:
        value = _with(_dataclass_in(kind)() if now is None else now, rest, value)
    elif value == "default" and _dataclass_in(kind) is not None:
        value = _dataclass_in(kind)() if now is None else now
    elif isinstance(value, list):
        value = tuple(value)
    return replace(part, **{first: value})


def _leaves(kind: type, before: str = "") -> Iterator[_Field]:
    hints = get_type_hints(kind)
    for each in fields(kind):
        name, inner = f"{before}{each.name}", _dataclass_in(hints[each.name])
        if inner is None:
            yield _Field(name, hints[each.name])
            continue
        if not is_dataclass(hints[each.name]):
            yield _Field(name, hints[each.name], part=True)
        yield from _leaves(inner, f"{name}.")


def _dataclass_in(kind: Any) -> Any:
    """The dataclass that a type is, or may be; None when it is none."""
    return next((each for each in (kind, *get_args(kind)) if isinstance(each, type) and is_dataclass(each)), None)


def _value_of(tree: Any, leaf: _Field) -> Any:
    """Of a preset as a dictionary; None within a group that is left out."""
    for name in leaf.name.split("."):
        tree = None if tree is None else tree[name]
    return "default" if leaf.part and tree is not None else tree


def _entry(leaf: _Field, values: Mapping[str, Any]) -> dict[str, object]:
    parts = get_args(leaf.type) if get_origin(leaf.type) in (Union, UnionType) else (leaf.type,)
    entry: dict[str, object] = {"name": leaf.name, **_kind(leaf, next(part for part in parts if part is not NoneType))}
    if entry["kind"] in ("int", "float", "ints", "floats"):
        least, most = RANGES.get(leaf.name, (TINY if leaf.name.startswith("rates.") else 0, None))
        entry |= {"least": least} | ({} if most is None else {"most": most})
    if NoneType in parts:
        entry["can_be_none"] = True
    return entry | {"values": values}


def _kind(leaf: _Field, kind: Any) -> dict[str, object]:
    if leaf.part:
        return {"kind": "part"}
    if get_origin(kind) is Literal:
        return {"kind": "choice", "choices": list(get_args(kind))}
    if get_origin(kind) is tuple:
        first, *others = get_args(kind)
        length = LEVELS if Ellipsis in others else 1 + len(others)
        return {"kind": f"{first.__name__}s", "length": length}
    return {"kind": {bool: "bool", int: "int", float: "float"}[kind]}
