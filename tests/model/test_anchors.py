"""Voxelisation and what an anchor starts with."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from engine.model.anchors import initial_anchors, spacing, voxelise


def test_rounds_half_to_even_and_removes_duplicates() -> None:
    halves = np.array([0.5, 0.49, 1.5, 2.5, 3.5])
    centres = voxelise(np.stack([halves, 0 * halves, 0 * halves], axis=1) * 0.125, 0.125)
    np.testing.assert_array_equal(centres[:, 0], [0.0, 0.25, 0.5])


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5))
def test_every_point_has_a_centre_within_half_a_voxel(seed: int, size: float) -> None:
    points = np.random.default_rng(seed).uniform(-3, 3, (50, 3))
    centres = voxelise(points, size)
    nearest = np.abs(points[:, None] - centres[None]).max(axis=2).min(axis=1)
    assert nearest.max() <= size / 2 + 1e-5
    assert len(np.unique(np.round(centres / size), axis=0)) == len(centres)


def test_spacing_is_the_root_mean_square_of_three_neighbours() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    assert spacing(points)[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))


def test_selecting_keeps_all_rows_aligned() -> None:
    positions = np.arange(30, dtype=np.float32).reshape(10, 3)
    anchors = initial_anchors(
        positions,
        np.arange(10),
        gaussians_per_anchor=4,
        feature=np.repeat(np.arange(10, dtype=np.float32)[:, None], 8, axis=1),
        voxel_size=0.1,
    )
    keep = torch.arange(10) % 3 == 0
    both = anchors.select(keep).extended(anchors.select(~keep))
    for row, label in enumerate(both.initial_class.tolist()):
        assert both.position[row, 0] == positions[label, 0]
        assert both.feature[row, 0] == label
