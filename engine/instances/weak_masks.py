"""Detects masks that are weak, and changes how votes count there (ours, beyond the paper). A network that is unsure
takes a thing for the class it has seen most. So if views contradict each other, votes for classes that are seldom shown
count more, and weak detections also vote, to win back what the panoptic mask lost. Both spoil good masks. So it is
measured: each view is held back in turn and compared with the votes of the other views. All classes count alike, since
even bad masks agree on walls and floors, which fill most views."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from ..presets.preset import EvidenceKind
from .agreement import ViewsOnCloud, votes_of_views
from .panoptic_labels import UNBALANCED, ClassBalance

log = logging.getLogger("plgs.lift")

WEAK = 0.6
"""Masks whose views agree with the others on less than this share of a class, in the mean over classes, are weak.
This parts good masks (0.66, 0.69) from bad ones (0.52, 0.53) on the sample and its twin only: elsewhere made masks had
0.29 to 0.35 and networks' 0.27 to 0.53, so all are weak (docs/experiments.md)."""
DOUBTED = 0.78
"""If they agree on less than this share of all that they show, common classes are doubtful, too. Two small
networks' masks had 0.66 to 0.77 (docs/experiments.md), other networks' 0.84 to 0.93, made masks 0.75 to 0.90."""
EVENING = 0.35
"""How much rare classes are favoured: 0 not at all, 1 until all classes have as many votes."""
RAREST = 0.02
"""Classes with less than this fraction of the commonest class's votes are not favoured further."""
STRAY = 0.001
"""Classes with less than this fraction of the commonest class's votes count as errors, and are not favoured at all."""
MAJORITY = 0.5
"""Share of the votes with which a class keeps a point or an object, unless common classes are doubtful."""


@dataclass(frozen=True)
class ViewAgreement:
    """How much of what a view shows agrees with the votes of all other views, 0 to 1: ``by_class``, the mean over
    classes; ``in_all``, over everything; ``at_least``, the same if what no other view sees counts as disagreeing."""

    by_class: float
    in_all: float
    at_least: float

    @property
    def is_weak(self) -> bool:
        return self.by_class < WEAK


def agreement_of_views(
    seeing: ViewsOnCloud, points: int, class_ids: tuple[int, ...], kind: EvidenceKind
) -> ViewAgreement:
    """Return how well the views of a cloud of ``points`` points agree; ``kind``: how votes are weighted. Points that no
    other view sees do not count."""
    ids = np.asarray(class_ids)
    said, total = votes_of_views(seeing, points, ids, kind)
    asked, agreed = np.zeros(len(ids)), np.zeros(len(ids))
    for row, column, weight in said:
        others = total[row]
        others[np.arange(len(row)), column] -= weight
        is_asked = others.max(1, initial=0) > 1e-5  # less is the rounding of the subtraction
        asked += np.bincount(column, weight * is_asked, len(ids))
        agreed += np.bincount(column, weight * (is_asked & (others.argmax(1) == column)), len(ids))
    if not asked.any():
        return ViewAgreement(1.0, 1.0, 0.0)  # nothing compared
    by_class, all_said = np.mean(agreed[asked > 0] / asked[asked > 0]), sum(weight.sum() for _, _, weight in said)
    found = ViewAgreement(float(by_class), float(agreed.sum() / asked.sum()), float(agreed.sum() / all_said))
    log.info(
        "held-out views agree with the others on %.3f of points (mean over classes; %.3f of all): the masks are %s",
        found.by_class, found.in_all, "weak" if found.is_weak else "good",
    )  # fmt: skip
    return found


def class_balance(
    seeing: ViewsOnCloud, points: int, class_ids: tuple[int, ...], kind: EvidenceKind, agreement: ViewAgreement
) -> ClassBalance:
    """Return weights of votes for ``class_ids`` that favour classes which views seldom show, if masks are weak by the
    views' ``agreement``; else all votes count alike."""
    if not agreement.is_weak:
        return UNBALANCED
    total = votes_of_views(seeing, points, np.asarray(class_ids), kind)[1].sum(0)
    share = total / max(total.max(initial=0), 1e-12)
    weights = np.where(share < STRAY, 1.0, np.maximum(share, RAREST) ** -EVENING)
    return ClassBalance(tuple(weights.tolist()), MAJORITY if agreement.in_all >= DOUBTED else 1.0)
