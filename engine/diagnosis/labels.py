"""Do all views give a surface the same class? Masks that contradict each other between views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..posed.layout import listed
from ..scene import VOID
from ..scene.pixels import resize_nearest
from .findings import Finding
from .looks import Floats, values_at
from .pictures import side_by_side
from .reprojection import Assumption, Examined

_WIDTH = 320
"""The width in pixels of the masks that are compared."""
_SAME_SURFACE = 0.5
"""Least agreement in depth, 0..1, of two views of one surface: about 2.7 % of the depth."""
_FEWEST_POINTS = 100
_UNRELATED = 0.5
_FOREIGN, _PROBABLY_FOREIGN = 0.25, 0.35
"""Shares of the median agreement beyond chance. A foreign mask also reaches some: floors are low in all pictures."""
_LESS = 0.25
"""A foreign mask is also this much below the median. Where masks have one class, or one has nearly all points, even
foreign ones agree, and nothing is told of them."""


class LabelAgreement(NamedTuple):
    """``counts`` float64 [C, C]: points of one class in one view and of another in the other view, without void.
    ``by_look`` float64 [F]: share of a look's points that other views give the same class, nan where there are too few.
    """

    counts: Floats
    by_look: Floats

    @property
    def share(self) -> float:
        """The share of all points named by both views to which both give the same name."""
        return float(np.trace(self.counts) / max(self.counts.sum(), 1.0))

    @property
    def middle(self) -> float:
        """The median of the looks' shares, 0 where there are too few points of each."""
        shares = self.by_look[np.isfinite(self.by_look)]
        return float(np.median(shares)) if len(shares) else 0.0

    @property
    def chance(self) -> float:
        """The share that two unrelated masks would have."""
        return float(np.square(self.counts.sum(1) / max(self.counts.sum(), 1.0)).sum())


def measure_labels(examined: Examined, assumed: Assumption) -> LabelAgreement | None:
    """Compare the labels of points whose depth agrees. Raises PlgsError."""
    views, pairs = examined.views, examined.pairs
    if any(look.frame.read_mask is None for look in views.looks):
        return None
    maps = [_reduced(look.frame.mask(None).class_map()) for look in views.looks]
    ids = tuple(sorted({*np.concatenate([np.unique(each) for each in maps]).tolist()} - {VOID}))
    if not ids:
        return None
    row_of = np.zeros(max(ids) + 1, np.int64)
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
        np.add.at(counts, (a, b), 1.0)
        np.add.at(counts, (b, a), 1.0)
        for look in (one, other):
            same[look] += float((a == b).sum())
            total[look] += len(a)
    return LabelAgreement(counts, np.where(total >= _FEWEST_POINTS, same / np.maximum(total, 1.0), np.nan))


def _reduced(classes: NDArray[np.int32]) -> NDArray[np.int32]:
    height, width = classes.shape
    return resize_nearest(classes, (_WIDTH, max(1, round(height * _WIDTH / width)))) if width > _WIDTH else classes


def label_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Masks that contradict each other where views see the same surface. Raises PlgsError."""
    labels = measure_labels(examined, assumed)
    if labels is None or labels.counts.sum() < 10 * _FEWEST_POINTS:
        return []
    if labels.share < _UNRELATED:
        return [_unrelated_masks(examined, labels)]
    odd = odd_looks(labels)
    return [_odd_masks(examined, labels, odd)] if odd else []


def odd_looks(labels: LabelAgreement) -> list[int]:
    """The looks whose masks agree little more with the others' than by chance, where most agree well."""
    middle = labels.middle
    kept = (labels.by_look - labels.chance) / max(middle - labels.chance, 1e-6)
    kept[~(labels.by_look < middle - _LESS)] = 1.0
    return np.flatnonzero(kept < _PROBABLY_FOREIGN).tolist() if (kept < _FOREIGN).any() else []


def _unrelated_masks(examined: Examined, labels: LabelAgreement) -> Finding:
    return Finding(
        cause="contradicting masks",
        severity="wrong",
        text=f"two views give the same class to only {labels.share:.0%} of the points that both see",
        option="check that each mask belongs to its frame, and that all use the same class table",
        figures={"share": labels.share},
        picture=_masks_shown(examined, [0, 1]),
    )


def _odd_masks(examined: Examined, labels: LabelAgreement, rows: list[int]) -> Finding:
    names = tuple(examined.name(row) for row in rows)
    worst = float(min(labels.by_look[row] for row in rows))
    return Finding(
        cause="contradicting masks",
        severity="wrong",
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
