"""Do the names of the classes fit the surfaces? Floors are level and seen from above, ceilings from below, walls are
upright."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

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


class Suiting(NamedTuple):
    """The points whose class has the name of a kind: how many there are, and which share of them fits the name."""

    points: int
    share: float


def measure_table(examined: Examined, assumed: Assumption, up: Floats) -> dict[str, Suiting]:
    """Each kind of surface that classes name and that enough points show. Raises PlgsError."""
    views = examined.views
    if any(look.frame.read_mask is None for look in views.looks):
        return {}
    limit = np.radians(_WITHIN)
    kind_of = {each.id: kind for each in examined.scene.classes.categories if (kind := _kind(each.name))}
    suits = dict.fromkeys(_KINDS, 0)
    total = dict.fromkeys(_KINDS, 0)
    for row, (normals, known) in enumerate(world_normals(views, assumed)):
        at = views.places[row][views.values[row] > 0.0][known]
        classes = values_at(examined.looks[row].frame.mask(None).class_map(), at)
        steep = normals[known] @ up
        level, upright = np.cos(limit), np.sin(limit)
        is_kind = {"floor": steep > level, "ceiling": steep < -level, "wall": np.abs(steep) < upright}
        for kind in _KINDS:
            named = np.isin(classes, [each for each, found in kind_of.items() if found == kind])
            total[kind] += int(named.sum())
            suits[kind] += int((named & is_kind[kind]).sum())
    return {kind: Suiting(total[kind], suits[kind] / total[kind]) for kind in _KINDS if total[kind] >= _FEWEST_POINTS}


def _kind(name: str) -> str | None:
    first, *others = re.findall("[a-z]+", name.lower()) or [""]
    return next((kind for kind, known in _KINDS.items() if first in known and {*others} <= _FURTHER), None)


def table_findings(examined: Examined, assumed: Assumption, up: Floats) -> list[Finding]:
    """Class ids that mean something other than the table says. Raises PlgsError."""
    found = measure_table(examined, assumed, up)
    wrong = {kind: each for kind, each in found.items() if each.share < _DIFFERS}
    is_enough = sum(each.points for each in wrong.values()) >= 2 * _FEWEST_POINTS
    if not is_enough or any(each.share >= _SUITS for each in found.values()):
        return []
    told = "; ".join(f"{each.share:.0%} of what is called {kind} {_WHAT[kind]}" for kind, each in wrong.items())
    return [
        Finding(
            cause="class table",
            severity="wrong",
            text=f"the names of the classes do not fit the surfaces: {told}",
            option="check that ids and names come from the same table: one may count from 0 and another from 1",
            figures={f"{kind}_share": each.share for kind, each in found.items()},
        )
    ]
