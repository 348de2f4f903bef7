from __future__ import annotations

import numpy as np
import pytest

from engine.semantics.clustering import cell_keys, lloyd_step, seed_centres

CLOUD = np.random.default_rng(1).uniform(0, 1, (4000, 3)) * [1.0, 1.0, 0.05]


def batches() -> list[np.ndarray]:
    return [CLOUD[:1500], CLOUD[1500:]]


def test_seeds_are_the_means_of_the_cells_however_the_cloud_is_cut() -> None:
    centres, spacing = seed_centres(batches, 0.25, 1000)
    whole, _ = seed_centres(lambda: [CLOUD], 0.25, 1000)
    assert spacing == 0.25 and len(centres) == 16
    np.testing.assert_allclose(centres, whole, atol=1e-12)
    first = CLOUD[(CLOUD < 0.25).all(1)].mean(0)
    np.testing.assert_allclose(centres[0], first, atol=1e-12)


def test_the_cap_enlarges_the_spacing() -> None:
    centres, spacing = seed_centres(batches, 0.02, 100)
    assert len(centres) <= 100 and spacing > 0.02


def test_lloyd_steps_do_not_raise_the_quantisation_error() -> None:
    def error(centres: np.ndarray) -> float:
        return float(((CLOUD[:, None] - centres[None]) ** 2).sum(-1).min(1).mean())

    centres, spacing = seed_centres(batches, 0.25, 1000)
    moved = lloyd_step(batches, centres, spacing)
    assert error(moved) < error(centres)


def test_cells_are_floors_and_far_points_are_refused() -> None:
    keys = cell_keys(np.array([[0.0, 0.0, 0.0], [0.099, 0.0, 0.0], [-0.001, 0.0, 0.0]]), 0.1)
    assert keys[0] == keys[1] != keys[2]
    with pytest.raises(ValueError, match="origin"):
        cell_keys(np.array([[2e5, 0.0, 0.0]]), 0.1)
