"""What an anchor starts with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.model.anchors import initial_anchors, spacing


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
