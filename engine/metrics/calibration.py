"""How often a share of the votes is right: the masks calibrate it, without any ground truth.

A pixel shows a class with a share of its coverage. Two questions make a probability of that share. Does the lift show
what the masks of all views together say of the place? And are the masks together right? One mask is often wrong where
many are right together, so a single mask does not answer the first: the class that most views name there does. The
second cannot be read from the masks' agreement. But masks that agree with the lift more often than their own scores
claim to be right are wrong together, and that much is taken off.

What is left: networks that call a sofa a bed from everywhere, with scores that are too high, are believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import VOID, View

STEPS = 1024
"""Probabilities are whole multiples of 1 / this, like the shares of the passes."""
BINS = 20
"""Bins of the fit, each with about equally many samples."""
LEAST_SAMPLES = 200
"""With fewer judged samples nothing is calibrated."""
LEAST_VIEWS = 2
"""The masks' verdict on a place needs at least this many views of it."""
MOST_SAMPLES = 60_000
"""The most places that are judged."""
BEHIND, BEHIND_SHARE = 0.05, 0.02
"""A view sees a place if its depth there differs by less than these metres, or this share of it."""


@dataclass(frozen=True)
class Calibration:
    """The probability ``right`` for each ``share`` in ascending order, with straight lines between them. Without any,
    a share is taken as it is. ``factor``: how far the masks together are believed, which is part of ``right``;
    ``samples``: how many places the masks judged."""

    share: tuple[float, ...] = ()
    right: tuple[float, ...] = ()
    factor: float = 1.0
    samples: int = 0

    def __post_init__(self) -> None:
        """Raises ValueError for what is not a monotone map of [0, 1] to [0, 1]."""
        values = np.array([self.share, self.right], np.float64)
        if not ((values >= 0) & (values <= 1)).all() or (np.diff(values) < 0).any():
            raise ValueError("the calibration is not a monotone map")

    def __call__(self, share: NDArray[np.float32]) -> NDArray[np.float32]:
        """The probabilities of shares, float32 of the same shape; 0, which is nothing, stays 0."""
        if not self.share:
            return share
        found = np.rint(STEPS * np.interp(share, self.share, self.right)) / STEPS
        return np.where(share > 0, found, 0).astype(np.float32)

    def doubt(self, pixels: NDArray[np.int64]) -> float:
        """How likely one of the ``pixels`` is wrong: how many have each share, int64 [STEPS + 1]."""
        wrong = 1.0 - self(np.linspace(0, 1, STEPS + 1, dtype=np.float32))
        return float((pixels * wrong).sum() / max(pixels.sum(), 1))


UNCALIBRATED = Calibration()


class Samples(NamedTuple):
    """Places that show a class: ``xyz`` float32 [N, 3] world metres, ``class_id`` int32 [N], ``share`` float32 [N]."""

    xyz: NDArray[np.float32]
    class_id: NDArray[np.int32]
    share: NDArray[np.float32]

    def fewer(self) -> Samples:
        """At most MOST_SAMPLES of those that show a class, evenly chosen."""
        rows = np.flatnonzero(self.class_id)
        rows = rows[:: -(-len(rows) // MOST_SAMPLES) or 1]
        return Samples(self.xyz[rows], self.class_id[rows], self.share[rows])


def samples_of(view: View, class_id: NDArray[np.int32], share: NDArray[np.float32], most: int) -> Samples:
    """At most ``most`` pixels of a view, evenly chosen from those with depth that show a class int32 [H, W]."""
    seen = np.flatnonzero((view.depth > 0) & (class_id > 0))
    seen = seen[:: max(1, -(-len(seen) // max(most, 1)))]
    xyz = view.camera.unproject(view.depth).reshape(-1, 3)[seen]
    return Samples(xyz.astype(np.float32), class_id.ravel()[seen], share.ravel()[seen])


def calibrate(samples: Samples, trained: Sequence[View], held_back: Sequence[View]) -> Calibration:
    """Let the masks of all views judge places. The masks that were ``held_back`` say how far masks are believed; if
    none were, those that the lift was ``trained`` on do. Each view is read once."""
    named = _Named(samples)
    for view in trained:
        named.add(view, is_judge=not len(held_back))
    for view in held_back:
        named.add(view, is_judge=True)
    is_judged = named.views >= LEAST_VIEWS
    if np.count_nonzero(is_judged) < LEAST_SAMPLES:
        return UNCALIBRATED
    share, right = fitted(samples.share[is_judged], named.verdict()[is_judged])
    factor = min(1.0, named.score / max(named.agreeing, 1e-9))
    right = tuple(round(factor * one, 6) for one in right)
    return Calibration(share, right, round(factor, 6), int(np.count_nonzero(is_judged)))


class _Named:
    """What views name places: ``views`` float32 [N] is how many views name each place. ``agreeing``: how often judges
    name the class that the place shows; ``score``: the sum of their scores."""

    def __init__(self, samples: Samples) -> None:
        self._xyz = samples.xyz
        self._ids, self._column = np.unique(samples.class_id, return_inverse=True)
        self._votes = np.zeros((len(samples.xyz), len(self._ids)), np.float32)
        self.views = np.zeros(len(samples.xyz), np.float32)
        self.agreeing = self.score = 0.0

    def add(self, view: View, *, is_judge: bool) -> None:
        """Count the classes that a view's mask gives to the places that it sees."""
        pixel, depth = view.camera.project(self._xyz)
        inside = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < np.array(view.camera.size)).all(axis=1)
        row = np.flatnonzero(inside)
        x, y = pixel[row].astype(np.int64).T
        measured, mask, named = view.depth[y, x], view.mask.ids[y, x], view.mask.class_map()[y, x]
        near = np.abs(measured - depth[row]) <= np.maximum(BEHIND, BEHIND_SHARE * measured)
        counts = near & (measured > 0) & (named != VOID)
        row, mask, named = row[counts], mask[counts], named[counts]
        column = np.minimum(np.searchsorted(self._ids, named), len(self._ids) - 1)
        known = self._ids[column] == named
        self._votes[row[known], column[known]] += 1
        self.views[row] += 1
        if is_judge:
            scores = {segment.id: segment.score for segment in view.mask.segments}
            ids, place = np.unique(mask, return_inverse=True)
            self.score += float(np.array([scores.get(int(one), 1.0) for one in ids])[place].sum()) if len(ids) else 0.0
            self.agreeing += float((named == self._ids[self._column[row]]).sum())

    def verdict(self) -> NDArray[np.float64]:
        """Whether most views name the class that each place shows, float64 [N]; a part of 1 where several tie."""
        most = self._votes.max(axis=1, initial=0)
        own = self._votes[np.arange(len(self._votes)), self._column]
        others = self.views - self._votes.sum(axis=1)  # classes that no place shows
        wins = (own == most) & (own > 0) & (own >= others)
        return np.asarray(wins / np.maximum((self._votes == most[:, None]).sum(axis=1), 1), np.float64)


def fitted(share: NDArray[np.floating], right: NDArray[np.floating]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The isotonic fit to samples [N], by bins of about equally many: ascending shares, and how often each is right. It
    begins at 0, where nothing is."""
    edges = np.unique(np.quantile(share, np.linspace(0, 1, BINS + 1)[1:-1]))
    number = np.searchsorted(edges, share, side="right")
    count = np.bincount(number, minlength=len(edges) + 1)
    means = [np.bincount(number, each, len(count))[count > 0] / count[count > 0] for each in (share, right)]
    blocks: list[tuple[float, int, int]] = []  # sum, samples, bins
    for value, weight in zip(means[1].tolist(), count[count > 0].tolist(), strict=True):
        blocks.append((value * weight, weight, 1))
        while len(blocks) > 1 and blocks[-2][0] * blocks[-1][1] >= blocks[-1][0] * blocks[-2][1]:
            last, before = blocks.pop(), blocks.pop()
            blocks.append((before[0] + last[0], before[1] + last[1], before[2] + last[2]))
    pooled = [total / weight for total, weight, bins in blocks for _ in range(bins)]
    shares, probabilities = ([0.0, *(round(one, 6) for one in each)] for each in (means[0].tolist(), pooled))
    return tuple(shares), tuple(probabilities)
