"""Do the names of the classes fit the surfaces? Floors are level and seen from above, ceilings from below, walls are
upright."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..posed.classes import VOID
from .findings import Finding
from .looks import Floats, values_at
from .reprojection import Assumption, Examined
from .up import world_normals

_KINDS = {"floor": ("floor", "flooring", "rug", "carpet"), "ceiling": ("ceiling",), "wall": ("wall",)}
"""The first words of class names, by the kind of their surfaces."""
_FURTHER = {"other", "merged", "brick", "wood", "stone", "tile", "concrete", "panel", "marble", *_KINDS["floor"]}
"""Words that may follow. A wall-cabinet is not a wall."""
_WHAT = {"floor": "is level, seen from above", "ceiling": "is level, seen from below", "wall": "is upright"}
_WITHIN = 25.0
"""Degrees by which a surface may differ from level or upright, as clothes, shelves and noise do."""
_FEWEST_POINTS = 200
_SUITS, _DIFFERS = 0.5, 0.25
"""Shares of a kind's points that fit its name: the least in a right table, and the most in a wrong one."""
_LARGE, _FEW, _LOOKS = 0.05, 0.2, 0.75
"""Shares of all points: the least of large stuff, and the most of walls and ceilings in a room that nearly lacks them;
and the least share of a class's points that look like a kind, if the class does."""
_LEVEL = set(
    "road pavement sidewalk grass earth ground path field sand dirt gravel snow land terrain runway water sea "
    "platform playingfield stage stairs stairway table counter desk bed cabinet shelf shelves bookshelf".split()
)
"""First words of other stuff that is level."""
_OPTION = (
    "check that ids and names come from the same table, and its numbering: one may count from 0 and another from 1 "
    "(--classes ade20k:1-150, --classes coco:90, --classes nyu40:0-39), and ScanNet's may be --classes scannet or nyu13"
)


class Suiting(NamedTuple):
    """The points whose class has the name of a kind: how many there are, and which share of them fits the name."""

    points: int
    share: float


Counts = defaultdict[int, Counter[str]]
"""For each class how many points it has ("all"), and how many look like each kind."""


def measure_table(examined: Examined, assumed: Assumption, up: Floats) -> Counts:
    """How the surfaces of each class look. Raises PlgsError."""
    views = examined.views
    if any(look.frame.read_mask is None for look in views.looks):
        return defaultdict(Counter)
    level, upright = np.cos(np.radians(_WITHIN)), np.sin(np.radians(_WITHIN))
    counts: Counts = defaultdict(Counter)
    for row, (normals, known) in enumerate(world_normals(views, assumed)):
        at = views.places[row][views.values[row] > 0.0][known]
        classes = values_at(examined.looks[row].frame.mask(None).class_map(), at)
        steep = normals[known] @ up
        is_kind = {"floor": steep > level, "ceiling": steep < -level, "wall": np.abs(steep) < upright}
        for class_id in {*np.unique(classes).tolist()} - {VOID}:
            named = classes == class_id
            counts[class_id].update({kind: int((named & each).sum()) for kind, each in is_kind.items()})
            counts[class_id]["all"] += int(named.sum())
    return counts


def _suiting(counts: Counts, kind_of: Mapping[int, str]) -> dict[str, Suiting]:
    """Each kind of surface that classes name and that enough points show."""
    found = {}
    for kind in _KINDS:
        named = [each for class_id, each in counts.items() if kind_of.get(class_id) == kind]
        points = sum(each["all"] for each in named)
        if points >= _FEWEST_POINTS:
            found[kind] = Suiting(points, sum(each[kind] for each in named) / points)
    return found


def _kind(name: str) -> str | None:
    first, *others = re.findall("[a-z]+", name.lower()) or [""]
    return next((kind for kind, known in _KINDS.items() if first in known and {*others} <= _FURTHER), None)


def table_findings(examined: Examined, assumed: Assumption, up: Floats) -> list[Finding]:
    """Class ids that mean something other than the table says. Raises PlgsError."""
    counts = measure_table(examined, assumed, up)
    classes = examined.scene.classes
    kind_of = {each.id: kind for each in classes.categories if (kind := _kind(each.name))}
    found = _suiting(counts, kind_of)
    wrong = {kind: each for kind, each in found.items() if each.share < _DIFFERS}
    is_enough = sum(each.points for each in wrong.values()) >= 2 * _FEWEST_POINTS
    if not is_enough or any(each.share >= _SUITS for each in found.values()):
        return _nameless(counts, found, {each.id: each.name for each in classes.categories if not each.is_thing})
    told = "; ".join(f"{each.share:.0%} of what is called {kind} {_WHAT[kind]}" for kind, each in wrong.items())
    return [
        Finding(
            cause="class table",
            severity="wrong",
            text=f"the names of the classes do not fit the surfaces: {told}",
            option=_OPTION,
            figures={f"{kind}_share": each.share for kind, each in found.items()},
        )
    ]


def _nameless(counts: Counts, found: Mapping[str, Suiting], stuff: Mapping[int, str]) -> list[Finding]:
    """A room without a floor and nearly without walls, where other stuff is level."""
    points = sum(each["all"] for each in counts.values())
    if "floor" in found or sum(each.points for each in found.values()) > _FEW * points:
        return []
    told = [
        f"{name} {_WHAT[kind]}"
        for class_id, name in stuff.items()
        for kind in ("floor", "ceiling")
        if re.split("[^a-z]", name.lower())[0] not in _LEVEL and _kind(name) is None
        and counts[class_id]["all"] >= max(_FEWEST_POINTS, _LARGE * points)
        and counts[class_id][kind] >= _LOOKS * counts[class_id]["all"]
    ]  # fmt: skip
    text = f"no class is a floor, and {'; '.join(told)}"
    return [Finding(cause="class table", severity="note", text=text, option=_OPTION)] if told else []
