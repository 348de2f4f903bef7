"""Do the views call the same surface the same? The labels of points that two views see, compared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import VOID
from ..scene.pixels import resize_nearest
from .reprojection import Assumption, Floats, Views

_WIDTH = 320
_SAME_SURFACE = 0.5
"""Of the agreement in depth, 0..1: about 2.7 % of the depth."""


class LabelAgreement(NamedTuple):
    """``counts`` float64 [C, C]: how many points have the one class in one view and the other in another; rows and
    columns in the order of ``class_ids``, void left out. ``by_look`` float64 [F]: the share of a look's points that are
    called the same by the others, nan where there are too few. ``by_class`` float64 [C] alike.
    """

    class_ids: tuple[int, ...]
    counts: Floats
    by_look: Floats
    by_class: Floats

    @property
    def share(self) -> float:
        """Of all points that both views name: how many they name the same."""
        return float(np.trace(self.counts) / max(self.counts.sum(), 1.0))


def measure_labels(views: Views, pairs: NDArray[np.int64], assumed: Assumption, least: int) -> LabelAgreement | None:
    """Compare labels of points whose depth agrees; shares of fewer than ``least`` points are nan. Raises SceneError."""
    if any(look.frame.read_mask is None for look in views.looks):
        return None
    maps = [_small(look.frame.mask(None).class_map()) for look in views.looks]
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
        ours, theirs = _at(maps[one], views.places[one][agrees]), _at(maps[other], comparison.place[row][agrees])
        named = (ours != VOID) & (theirs != VOID)
        a, b = row_of[ours[named]], row_of[theirs[named]]
        np.add.at(counts, (a, b), 1.0)
        np.add.at(counts, (b, a), 1.0)
        for look in (one, other):
            same[look] += float((a == b).sum())
            total[look] += len(a)
    by_class = _share(np.diag(counts), counts.sum(1), 2 * least)
    return LabelAgreement(ids, counts, _share(same, total, least), by_class)


def _small(classes: NDArray[np.int32]) -> NDArray[np.int32]:
    height, width = classes.shape
    return resize_nearest(classes, (_WIDTH, max(1, round(height * _WIDTH / width)))) if width > _WIDTH else classes


def _at(classes: NDArray[np.int32], places: Floats) -> NDArray[np.int32]:
    height, width = classes.shape
    columns = np.clip((places[:, 0] * width).astype(np.int64), 0, width - 1)
    rows = np.clip((places[:, 1] * height).astype(np.int64), 0, height - 1)
    return classes[rows, columns]


def _share(part: Floats, whole: Floats, least: int) -> Floats:
    return np.where(whole >= least, part / np.maximum(whole, 1.0), np.nan)
