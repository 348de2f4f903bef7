"""Segments that should be of one class: which one, the model itself says."""

from __future__ import annotations

import numpy as np
import torch

from engine.train.label_losses import ThingSegments
from research.baselines.method import segment_targets


def test_a_segment_takes_the_class_that_it_shows_most_certainly() -> None:
    ids = np.array([[3, 3, 3, 0], [9, 9, 9, 9]])
    shown = np.zeros((2, 4, 3), np.float32)
    shown[0] = [[0.6, 0.4, 0.1], [0.6, 0.4, 0.1], [0.01, 0.99, 0.1], [1.0, 0.0, 0.1]]  # twice class 0, but unsurely
    shown[1] = [0.7, 0.3, 0.0]
    targets = segment_targets(torch.from_numpy(0.5 * shown), torch.full((2, 4), 0.5), 2, ThingSegments.of(ids))
    assert targets.dtype == torch.int16
    assert targets.tolist() == [[1, 1, 1, -1], [0, 0, 0, 0]]


def test_without_segments_there_is_no_target() -> None:
    nothing = ThingSegments.of(np.zeros((2, 2), np.int32))
    targets = segment_targets(torch.ones(2, 2, 3), torch.ones(2, 2), 2, nothing)
    assert targets.tolist() == [[-1, -1], [-1, -1]]
