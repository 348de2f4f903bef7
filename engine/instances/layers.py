"""Whether detections that lie over the masks take part in votes (ours, beyond the paper).

Weak detections win back what a network's panoptic picture lost, but spoil masks that are good. So the views decide:
each is held back in turn and compared with what the others say of its points. Averages over a view's pixels decide
nothing: walls and floors fill it, and even bad masks agree on these. So all classes count alike.
"""

from __future__ import annotations

import logging

import numpy as np

from ..presets.preset import EvidenceKind
from .agreement import ViewsOnCloud, words_of_views

log = logging.getLogger("plgs.lift")

WEAK = 0.6
"""Masks whose views agree with the others on less than this share of a class, in the mean over classes, are weak.
Scenes with networks' masks had 0.32 to 0.50, those with good masks 0.66 to 0.71 (docs/experiments.md)."""


def trusted_layers(seeing: ViewsOnCloud, points: int, class_ids: tuple[int, ...], kind: EvidenceKind) -> ViewsOnCloud:
    """The layers of the views of a cloud of ``points`` points where masks are weak; else none. ``kind``: the votes that
    a view has on a point."""
    layers = seeing.layers()
    if not len(layers.views):
        return layers
    agreement = class_agreement(seeing, points, class_ids, kind)
    are_trusted = agreement < WEAK
    log.info(
        "a view that is held back agrees with the others on %.3f of a class: detections%s vote",
        agreement, "" if are_trusted else " do not",
    )  # fmt: skip
    return layers.looked_at(lambda *_: None) if are_trusted else layers.only(np.zeros(0, np.int64))


def class_agreement(seeing: ViewsOnCloud, points: int, class_ids: tuple[int, ...], kind: EvidenceKind) -> float:
    """The fraction of the points that a view's mask gives a class to which the votes of all other views give the same
    class: the mean over the classes that masks show. Points that no other view sees do not count."""
    ids = np.asarray(class_ids)
    said, total = words_of_views(seeing, points, ids, kind)
    asked, agreed = np.zeros(len(ids)), np.zeros(len(ids))
    for row, column, word in said:
        others = total[row]
        others[np.arange(len(row)), column] -= word
        is_asked = others.max(1, initial=0) > 1e-5  # less is the rounding of the subtraction
        asked += np.bincount(column, word * is_asked, len(ids))
        agreed += np.bincount(column, word * (is_asked & (others.argmax(1) == column)), len(ids))
    return float(np.mean(agreed[asked > 0] / asked[asked > 0])) if asked.any() else 1.0  # nothing compared
