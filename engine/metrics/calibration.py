"""Calibrates confidence: how often a class with a given share of the votes is right, by the masks, without ground
truth.

A pixel shows a class with a share of its coverage. Two questions turn that share into a probability. First: does the
lift show what all masks together say of this point? A single mask is too often wrong, so the class that most views show
there is the answer. Second: are the masks together right? Their agreement does not tell. But if masks agree with the
lift more often than their own scores claim to be right, they are wrong together, and the difference is subtracted.

A limit remains: networks that call a sofa a bed from every view, with scores that are too high, are believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import VOID, View

STEPS = 1024
"""Probabilities are whole multiples of 1 / STEPS, like the shares of the passes."""
BINS = 20
"""Bins of the fit, each with about equally many points."""
LEAST_VIEWS, LEAST_SAMPLES, MOST_SAMPLES = 2, 200, 60_000
"""Fewest views that must give a point a class, for it to count; fewest points for a calibration; most points used."""


@dataclass(frozen=True)
class Calibration:
    """A map from shares of votes to probabilities: ``right`` for each ``share``, ascending, interpolated linearly. If
    empty, a share is its own probability. ``factor``: how far masks are believed, already part of ``right``;
    ``samples``: the number of points that it was measured on."""

    share: tuple[float, ...] = ()
    right: tuple[float, ...] = ()
    factor: float = 1.0
    samples: int = 0

    def __post_init__(self) -> None:
        """Raise ValueError unless it is a monotone map from [0, 1] to [0, 1]."""
        values = np.array([self.share, self.right], np.float64)
        if not ((values >= 0) & (values <= 1)).all() or (np.diff(values) < 0).any():
            raise ValueError("the calibration is not a monotone map")

    def __call__(self, share: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the probabilities for an array of shares, float32 of the same shape; 0 (nothing rendered) stays 0."""
        if not self.share:
            return share
        found = np.rint(STEPS * np.interp(share, self.share, self.right)) / STEPS
        return np.where(share > 0, found, 0).astype(np.float32)

    def doubt(self, samples: Samples) -> float:
        """Return the mean probability that a sample's class is wrong; 0 without samples."""
        return float(np.mean(1 - self(samples.share))) if len(samples.share) else 0.0


UNCALIBRATED = Calibration()


class Samples(NamedTuple):
    """Points with the class that the lift shows: ``xyz`` float32 [N, 3], world metres; ``class_id`` int32 [N], 0 =
    none; ``share`` float32 [N], the share of the votes."""

    xyz: NDArray[np.float32]
    class_id: NDArray[np.int32]
    share: NDArray[np.float32]


def samples_of(view: View, class_id: NDArray[np.int32], share: NDArray[np.float32], most: int) -> Samples:
    """Return up to ``most`` evenly chosen pixels of a view with depth and class; ``class_id``, ``share`` are [H, W]."""
    seen = np.flatnonzero((view.depth > 0) & (class_id > 0))
    seen = seen[:: max(1, -(-len(seen) // max(most, 1)))]
    xyz = view.camera.unproject(view.depth).reshape(-1, 3)[seen]
    return Samples(xyz.astype(np.float32), class_id.ravel()[seen], share.ravel()[seen])


def calibrate(samples: Samples, trained: Sequence[View], held_back: Sequence[View]) -> Calibration:
    """Measure the calibration on up to MOST_SAMPLES samples, by the masks of all views. How far masks are believed is
    measured on the ``held_back`` views or, without these, on the ``trained`` views. Each view is read once."""
    rows = np.flatnonzero(samples.class_id)
    rows = rows[:: -(-len(rows) // MOST_SAMPLES) or 1]
    samples = Samples(samples.xyz[rows], samples.class_id[rows], samples.share[rows])
    named = _Named(samples)
    for views, is_judge in ((trained, not len(held_back)), (held_back, True)):
        for view in views:
            named.add(view, is_judge=is_judge)
    is_judged = named.views >= LEAST_VIEWS
    if np.count_nonzero(is_judged) < LEAST_SAMPLES:
        return UNCALIBRATED
    share, right = fitted(samples.share[is_judged], named.verdict()[is_judged])
    factor = min(1.0, named.score / max(named.agreeing, 1e-9))
    right = tuple(round(factor * one, 6) for one in right)
    return Calibration(share, right, round(factor, 6), int(np.count_nonzero(is_judged)))


class _Named:
    """What the masks say of each sample. ``views`` float64 [N]: how many views give the point a class. Over the judging
    views: ``agreeing``, how often it is the class that the lift shows, and ``score``, the sum of the masks' scores."""

    def __init__(self, samples: Samples) -> None:
        self._xyz = samples.xyz
        self._ids, self._column = np.unique(samples.class_id, return_inverse=True)
        self._votes, self.views = np.zeros((len(self._xyz), len(self._ids)), np.float32), np.zeros(len(self._xyz))
        self.agreeing = self.score = 0.0

    def add(self, view: View, *, is_judge: bool) -> None:
        """Count the classes that a view's mask gives to the samples it sees; if ``is_judge``, also sum its scores."""
        row, y, x = view.seen_of(self._xyz)
        mask, named = view.mask.ids[y, x], view.mask.class_map()[y, x]
        counts = named != VOID
        row, mask, named = row[counts], mask[counts], named[counts]
        column = np.minimum(np.searchsorted(self._ids, named), len(self._ids) - 1)
        known = self._ids[column] == named
        self._votes[row[known], column[known]] += 1
        self.views[row] += 1
        if is_judge:
            scores = {segment.id: segment.score for segment in view.mask.segments}
            ids, count = np.unique(mask, return_counts=True)
            self.score += sum(scores.get(one, 1.0) * n for one, n in zip(ids.tolist(), count.tolist(), strict=True))
            self.agreeing += float((named == self._ids[self._column[row]]).sum())

    def verdict(self) -> NDArray[np.float64]:
        """Return whether most views give each point the class that the lift shows, float64 [N]; 1 / n in a tie of n."""
        most = self._votes.max(axis=1, initial=0)
        own = self._votes[np.arange(len(self._votes)), self._column]
        unseen = self.views - self._votes.sum(axis=1)  # votes for classes that no sample shows
        wins = (own == most) & (own > 0) & (own >= unseen)
        return np.asarray(wins / np.maximum((self._votes == most[:, None]).sum(axis=1), 1), np.float64)


def fitted(share: NDArray[np.floating], right: NDArray[np.floating]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the isotonic fit to samples' ``share`` and ``right`` (0 to 1) [N], in bins of about equally many:
    ascending shares from 0, and how often each is right."""
    edges = np.unique(np.quantile(share, np.linspace(0, 1, BINS + 1)[1:-1]))
    number = np.searchsorted(edges, share, side="right")
    count = np.bincount(number, minlength=len(edges) + 1)
    count, sums = count[count > 0], [np.bincount(number, each)[count > 0] for each in (share, right)]
    from scipy.optimize import isotonic_regression  # late: it takes half a second, and few commands calibrate

    pooled = isotonic_regression(sums[1] / count, weights=count).x
    return (0.0, *np.round(sums[0] / count, 6).tolist()), (0.0, *np.round(pooled, 6).tolist())
