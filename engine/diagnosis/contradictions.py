"""Findings on labels: masks and classes that contradict each other between views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene.layout import listed
from .examined import Examined
from .finding import Finding
from .labels import LabelAgreement, measure_labels
from .pictures import side_by_side
from .reprojection import Assumption

_FEWEST_POINTS = 100
_UNRELATED = 0.5
_CONFUSED, _CONFUSED_SHARE = 0.25, 0.01
"""A class is contradicted when this part of it is called one other class, and that is this part of all points."""


def label_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Masks that contradict each other where views see the same surface. Raises SceneError."""
    labels = measure_labels(examined.views, examined.pairs, assumed, _FEWEST_POINTS)
    if labels is None or labels.counts.sum() < 10 * _FEWEST_POINTS:
        return []
    if labels.share < _UNRELATED:
        return [_of_all_masks(examined, labels)]
    middle = float(np.nanmedian(labels.by_look))
    odd = [row for row, share in enumerate(labels.by_look.tolist()) if share < _UNRELATED * middle]
    return [*([_of_masks(examined, labels, odd, middle)] if odd else []), *_confused(examined, labels)]


def _of_all_masks(examined: Examined, labels: LabelAgreement) -> Finding:
    return Finding(
        cause="contradicting masks",
        severity="wrong",
        text=f"views call only {labels.share:.0%} of the points the same that two of them see",
        option="see that each mask belongs to its frame, and that all have the same class table",
        figures={"share": labels.share},
        picture=_masks_shown(examined, [0, 1]),
    )


def _of_masks(examined: Examined, labels: LabelAgreement, rows: list[int], middle: float) -> Finding:
    names = tuple(examined.name(row) for row in rows)
    worst = float(min(labels.by_look[row] for row in rows))
    return Finding(
        cause="contradicting masks",
        severity="wrong",
        text=f"the masks of {listed(names)} contradict those of the other views: {worst:.0%} of their points are "
        f"called the same there, {middle:.0%} in the middle of all frames",
        option="see that these masks belong to these frames, or leave the frames out with a splits.json",
        figures={"share": worst, "middle": middle},
        frames=names,
        picture=_masks_shown(examined, [max(rows[0] - 1, 0), rows[0]]),
    )


def _confused(examined: Examined, labels: LabelAgreement) -> list[Finding]:
    """Pairs of classes that views exchange, the most frequent first."""
    total = labels.counts.sum()
    found = []
    for row, column in zip(*np.nonzero(labels.counts), strict=True):
        part = float(labels.counts[row, column] / labels.counts[row].sum())
        is_much = labels.counts[row, column] > _CONFUSED_SHARE * total
        if row != column and part > _CONFUSED and is_much:
            one, other = (examined.scene.classes[labels.class_ids[each]].name for each in (row, column))
            finding = Finding(
                cause="contradicting classes",
                severity="note",
                text=f"views contradict each other: {part:.0%} of what one calls {one} another calls {other}",
                option="a lift votes; see that the class table is the same for all masks",
                figures={"share": part, "class": one, "other": other},
                picture=_masks_shown(examined, _most_of(examined, labels.class_ids[row], labels.class_ids[column])),
            )
            found.append((float(labels.counts[row, column]), finding))
    return [finding for _, finding in sorted(found, key=lambda each: -each[0])]


def _most_of(examined: Examined, one: int, other: int) -> list[int]:
    """The look that shows most of the one class, and that of the other."""
    shares = [[(look.frame.mask(None).class_map() == each).mean() for look in examined.looks] for each in (one, other)]
    return [int(np.argmax(share)) for share in shares]


def _masks_shown(examined: Examined, rows: list[int]) -> NDArray[np.uint8]:
    table = examined.scene.classes
    shown = []
    for row in rows:
        classes = examined.looks[row].frame.mask(None).class_map()
        colours = np.zeros((int(classes.max()) + 1, 3), np.uint8)
        for category in table.categories:
            if category.id < len(colours):
                colours[category.id] = category.colour
        shown.append((examined.name(row), colours[classes]))
    return side_by_side(shown)
