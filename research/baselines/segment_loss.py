"""Panoptic Lifting's segment consistency: all of a segment should have one class, whichever it is."""

from __future__ import annotations

import numpy as np
import torch

from engine.train.assignment import ThingSegments
from engine.train.label_losses import TINY

WEIGHT = 1.2
"""The weight of this loss within L_sem."""
FROM = 0.6
"""The share of all steps before which it has no weight: earlier it teaches what is not learnt yet, and all classes
become one. Panoptic Lifting starts it at its sixth epoch."""


def segment_targets(coverage: torch.Tensor, alpha: torch.Tensor, classes: int, segments: ThingSegments) -> torch.Tensor:
    """The class of each pixel's segment, int16 [H, W], -1 outside of all: that of the largest mean log probability over
    the segment's pixels, as the model shows it now.

    ``coverage`` float32 [H, W, C + S] holds blended probabilities of ``classes`` C classes first; over ``alpha``
    [H, W] they are probabilities.
    """
    inside = segments.row.reshape(-1) >= 0
    row = segments.row.reshape(-1)[inside]
    shown = coverage.detach().reshape(-1, coverage.shape[-1]).numpy()[inside, :classes]
    logs = np.log(shown / (alpha.detach().reshape(-1, 1).numpy()[inside] + TINY) + TINY)
    count = len(segments.pixels)
    sums = np.column_stack([np.bincount(row, column, count) for column in logs.T])
    best = np.append(sums.argmax(axis=1) if count else [], -1).astype(np.int16)
    return torch.from_numpy(best[segments.row])  # row -1 is the last entry: no class
