from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.instances.assign_slots import assign_slots


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 5))
def test_it_is_the_best_of_all_assignments(seed: int, slots: int, instances: int) -> None:
    generator = np.random.default_rng(seed)
    shown = generator.dirichlet(np.ones(slots), (6, 8))
    ids = generator.integers(0, instances + 1, (6, 8)) * 7
    target = assign_slots(shown, ids)
    present = np.unique(ids[ids > 0])
    mean = np.array([shown[ids == i].mean(0) for i in present]).reshape(len(present), slots)
    small, large = sorted(mean.shape)
    table = mean if len(present) <= slots else mean.T
    best = max(sum(table[k, p[k]] for k in range(small)) for p in permutations(range(large), small))
    got = sum(mean[k, target[ids == i][0]] for k, i in enumerate(present) if target[ids == i][0] >= 0)
    assert got == pytest.approx(best)
    assert (target[ids == 0] == -1).all()
    assert all(len(np.unique(target[ids == i])) == 1 for i in present)


def test_instances_beyond_the_slots_are_not_supervised() -> None:
    shown = np.array([[[0.9, 0.1], [0.2, 0.8], [0.5, 0.5]]])
    assert assign_slots(shown, np.array([[3, 9, 4]])).tolist() == [[0, 1, -1]]


def test_a_view_without_instances_gives_no_supervision() -> None:
    assert (assign_slots(np.ones((2, 3, 4)), np.zeros((2, 3), np.int32)) == -1).all()


def test_sizes_must_fit() -> None:
    with pytest.raises(ValueError, match="fit"):
        assign_slots(np.ones((2, 3, 4)), np.zeros((3, 2), np.int32))
