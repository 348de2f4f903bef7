"""Check masks and class names: all views should give a surface the same class, and names should fit surfaces: floors
are level and seen from above, ceilings from below, walls are upright."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..posed.layout import listed
from ..scene import VOID
from ..scene.pixels import values_at
from .findings import Finding, side_by_side
from .reprojection import Assumption, Examined, Floats
from .up import world_normals

_SAME_SURFACE = 0.5  # minimum depth agreement, 0..1, of two views of one surface: about 2.7 % of the depth
_FEWEST_POINTS = 100
_UNRELATED, _ABOVE_CHANCE = 0.5, 0.1
"""Masks contradict each other below the first fraction of points with the same class, as weak networks' masks do;
within the second of the chance level they are useless."""
_FOREIGN, _PROBABLY_FOREIGN = 0.25, 0.35
"""Fractions of the median agreement beyond chance. Even a foreign mask reaches some: floors are low in all pictures."""
_LESS = 0.25
"""A foreign mask is also this much below the median. If masks have one class, or one has nearly all points, even
foreign ones agree, and no conclusion is possible."""


class LabelAgreement(NamedTuple):
    """How well masks agree. ``counts`` float64 [C, C]: points by class in one view and class in the other view, without
    void. ``by_look`` float64 [F]: fraction of a frame's points with the same class in others; nan: too few."""

    counts: Floats
    by_look: Floats

    @property
    def share(self) -> float:
        """The fraction of points labelled by both views that have the same label in both."""
        return float(np.trace(self.counts) / max(self.counts.sum(), 1.0))

    @property
    def middle(self) -> float:
        """The median of ``by_look``; 0 where all frames have too few points."""
        shares = self.by_look[np.isfinite(self.by_look)]
        return float(np.median(shares)) if len(shares) else 0.0

    @property
    def chance(self) -> float:
        """The ``share`` that two unrelated masks would reach by chance."""
        return float(np.square(self.counts.sum(1) / max(self.counts.sum(), 1.0)).sum())


def measure_labels(examined: Examined, assumed: Assumption) -> LabelAgreement | None:
    """Compare the classes of points whose depth agrees. None without masks. Raises PlgsError for a bad mask."""
    views, pairs, maps = examined.views, examined.pairs, examined.class_maps
    if maps is None:
        return None
    ids = tuple(sorted({*np.concatenate([np.unique(each) for each in maps]).tolist()} - {VOID}))
    if not ids:
        return None
    row_of = np.zeros(max(ids) + 1, np.int64)  # from class ids to rows of counts
    row_of[list(ids)] = np.arange(len(ids))
    comparison = views.compare(pairs, assumed)
    counts = np.zeros((len(ids), len(ids)))
    same, total = np.zeros(len(views.looks)), np.zeros(len(views.looks))
    for row, (one, other) in enumerate(pairs.tolist()):
        agrees = comparison.agrees[row] > _SAME_SURFACE
        ours = values_at(maps[one], views.places[one][agrees])
        theirs = values_at(maps[other], comparison.place[row][agrees])
        named = (ours != VOID) & (theirs != VOID)
        a, b = row_of[ours[named]], row_of[theirs[named]]
        np.add.at(counts, (a, b), 1.0)  # += would count repeated pairs once
        np.add.at(counts, (b, a), 1.0)
        for look in (one, other):
            same[look] += float((a == b).sum())
            total[look] += len(a)
    return LabelAgreement(counts, np.where(total >= _FEWEST_POINTS, same / np.maximum(total, 1.0), np.nan))


def label_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Return findings about masks that contradict each other. Raises PlgsError for a bad mask."""
    labels = measure_labels(examined, assumed)
    if labels is None or labels.counts.sum() < 10 * _FEWEST_POINTS:
        return []
    if labels.share < _UNRELATED:
        text = f"two views give the same class to only {labels.share:.0%} of the points that both see"
        option = "check that each mask belongs to its frame, and that all use the same class table"
        picture, stops = _masks_shown(examined, [0, 1]), labels.share < labels.chance + _ABOVE_CHANCE
        figures = {"share": labels.share}
        return [Finding("contradicting masks", text, option, figures=figures, picture=picture, stops=stops)]
    # The looks whose masks agree with the others' hardly more than by chance, if most agree well.
    kept = (labels.by_look - labels.chance) / max(labels.middle - labels.chance, 1e-6)
    kept[~(labels.by_look < labels.middle - _LESS)] = 1.0  # also for NaN: too few points say nothing
    odd = np.flatnonzero(kept < _PROBABLY_FOREIGN).tolist() if (kept < _FOREIGN).any() else []  # only if one is certain
    return [_odd_masks(examined, labels, odd)] if odd else []


def _odd_masks(examined: Examined, labels: LabelAgreement, rows: list[int]) -> Finding:
    names = tuple(examined.name(row) for row in rows)
    worst = float(min(labels.by_look[row] for row in rows))
    return Finding(
        cause="contradicting masks",
        text=f"the masks of {listed(names)} contradict those of the other views: {worst:.0%} of their points have the "
        f"same class there; the median of all frames is {labels.middle:.0%}",
        option="check that these masks belong to these frames, or leave the frames out with a splits.json",
        figures={"share": worst, "middle": labels.middle},
        frames=names,
        leave_out=names,
        picture=_masks_shown(examined, [max(rows[0] - 1, 0), rows[0]]),
    )


def _masks_shown(examined: Examined, rows: list[int]) -> NDArray[np.uint8]:
    shown = []
    for row in rows:
        classes = examined.looks[row].frame.mask(None).class_map()
        colours = np.zeros((int(classes.max()) + 1, 3), np.uint8)
        for category in examined.scene.classes.categories:
            if category.id < len(colours):
                colours[category.id] = category.colour
        shown.append((examined.name(row), colours[classes]))
    return side_by_side(shown)


_KINDS = {"floor": ("floor", "flooring", "rug", "carpet"), "ceiling": ("ceiling",), "wall": ("wall",)}
"""The first words of class names, by kind of surface."""
_FURTHER = {"other", "merged", "brick", "wood", "stone", "tile", "concrete", "panel", "marble", *_KINDS["floor"]}
"""Words that may follow the first. A wall-cabinet is not a wall."""
_WHAT = {"floor": "is level, seen from above", "ceiling": "is level, seen from below", "wall": "is upright"}
_WITHIN = 25.0  # maximum deviation in degrees from level or upright, as clothes, shelves and noise cause
_FEWEST_OF_KIND = 200
_CONTRADICTED = 0.05  # below this a table is wrong: 1 % fit tables off by one, 20 % distant and noisy floors
_SUITS, _DIFFERS = 0.5, 0.25  # fractions of a kind's points that fit its name: minimum if right, maximum if wrong
_OPTION = (
    "check that ids and names come from the same table, and its numbering: one may count from 0 and another from 1 "
    "(--classes ade20k:1-150, --classes coco:90, --classes nyu40:0-39), and ScanNet's may be --classes scannet or nyu13"
)


class Suiting(NamedTuple):
    """How well surfaces of some classes fit these classes' names: the ``points``, and the ``share`` that fits."""

    points: int
    share: float


Counts = defaultdict[int, Counter[str]]  # per class, its number of points ("all"), and how many look like each kind


def measure_table(examined: Examined, assumed: Assumption, up: Floats) -> Counts:
    """Return, by class, how many points masks give it ("all"), and how many of these look like "floor", "ceiling" and
    "wall" by their normals and the direction ``up`` [3]; none without masks. Raises PlgsError for a bad mask."""
    views, maps = examined.views, examined.class_maps
    if maps is None:
        return defaultdict(Counter)
    level, upright = np.cos(np.radians(_WITHIN)), np.sin(np.radians(_WITHIN))
    counts: Counts = defaultdict(Counter)
    for row, (normals, known) in enumerate(world_normals(views, assumed)):
        at = views.places[row][views.values[row] > 0.0][known]
        classes = values_at(maps[row], at)
        steep = normals[known] @ up
        is_kind = {"floor": steep > level, "ceiling": steep < -level, "wall": np.abs(steep) < upright}
        for class_id in {*np.unique(classes).tolist()} - {VOID}:
            named = classes == class_id
            counts[class_id].update({kind: int((named & each).sum()) for kind, each in is_kind.items()})
            counts[class_id]["all"] += int(named.sum())
    return counts


def _kind(name: str) -> str | None:
    first, *others = re.findall("[a-z]+", name.lower()) or [""]
    return next((kind for kind, known in _KINDS.items() if first in known and {*others} <= _FURTHER), None)


def table_findings(examined: Examined, assumed: Assumption, up: Floats) -> list[Finding]:
    """Return findings about class names that do not fit the surfaces; ``up`` float64 [3] is the vertical. Raises
    PlgsError for a bad mask."""
    counts = measure_table(examined, assumed, up)
    classes = examined.scene.classes
    kind_of = {each.id: kind for each in classes.categories if (kind := _kind(each.name))}
    found = {}  # each kind of surface that classes name and that enough points show
    for kind in _KINDS:
        named = [each for class_id, each in counts.items() if kind_of.get(class_id) == kind]
        points = sum(each["all"] for each in named)
        if points >= _FEWEST_OF_KIND:
            found[kind] = Suiting(points, sum(each[kind] for each in named) / points)
    wrong = {kind: each for kind, each in found.items() if each.share < _DIFFERS}
    is_enough = sum(each.points for each in wrong.values()) >= 2 * _FEWEST_OF_KIND
    if not is_enough or any(each.share >= _SUITS for each in found.values()):
        return []
    reasons = "; ".join(f"{each.share:.0%} of what is called {kind} {_WHAT[kind]}" for kind, each in wrong.items())
    finding = Finding(
        cause="class table",
        text=f"the names of the classes do not fit the surfaces: {reasons}",
        option=_OPTION,
        figures={f"{kind}_share": each.share for kind, each in found.items()},
        stops=all(each.share < _CONTRADICTED for each in wrong.values()),
    )
    return [finding]
