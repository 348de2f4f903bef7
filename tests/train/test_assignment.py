"""The assignment of a training step gives what ``assign_slots`` gives."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.train.label_losses import ThingSegments, assigned_slots
from tests.instances.assign_slots import assign_slots


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 6), st.integers(0, 5), st.integers(0, 3))
def test_it_is_the_plain_assignment(seed: int, slots: int, instances: int, first: int) -> None:
    random = np.random.default_rng(seed)
    coverage = random.random((90, 101, first + slots), dtype=np.float32)
    alpha = random.uniform(0.1, 1.0, (90, 101)).astype(np.float32)
    ids = random.integers(0, instances + 1, (90, 101)) * 1000
    if seed % 2:
        ids[ids == 0] = 7  # every pixel is of some instance
    got = assigned_slots(torch.from_numpy(coverage), torch.from_numpy(alpha), first, ThingSegments.of(ids))
    probability = coverage[..., first:].astype(np.float64) / (alpha[..., None].astype(np.float64) + 1e-8)
    assert got.dtype == torch.int16
    assert (got.numpy() == assign_slots(probability, ids)).all()


def test_segments_are_counted() -> None:
    things = ThingSegments.of(np.array([[0, 9, 9], [4, 0, 9]]))
    assert things.row.tolist() == [[-1, 1, 1], [0, -1, 1]]
    assert things.pixels.tolist() == [1, 3]
    assert not len(ThingSegments.of(np.zeros((2, 2), np.int32)).pixels)
