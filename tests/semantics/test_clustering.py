"""Clusters of a cloud: even, and where it is too large, dense where labels change."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial import cKDTree

from engine.semantics.clustering import ColumnedPoints, adapted_centres, lloyd_step, seed_centres

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


SIDE, WANTED, CAP = 20.0, 0.05, 10_000
RUG = ((4.0, 9.0), (11.0, 16.0))
"""Corners of a rug on a floor of 20 x 20 m, metres."""


def is_rug(points: np.ndarray) -> np.ndarray:
    return np.logical_and.reduce(
        [(low < points[:, axis]) & (points[:, axis] < high) for axis, (low, high) in enumerate(RUG)]
    )


def floor(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    return np.column_stack([SIDE * random.random((60_000, 2)), np.zeros(60_000)])


def views(rug: int) -> Iterable[ColumnedPoints]:
    """Ten views of the whole floor; the rug has the class with index ``rug``."""
    for seed in range(10):
        points = floor(seed)
        yield points, np.where(is_rug(points), rug, 0)


def even() -> tuple[np.ndarray, float]:
    return seed_centres(lambda: (points for points, _ in views(1)), WANTED, CAP)


def gaps(centres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The distance from each point to its nearest centre."""
    return np.asarray(cKDTree(centres).query(points)[0])


def test_points_are_dense_at_the_edge_of_a_label_and_nowhere_too_sparse() -> None:
    centres, spacing = even()
    assert spacing > 2 * WANTED
    adapted = adapted_centres(lambda: views(1), centres, spacing, 2, WANTED, CAP)
    assert len(adapted) <= CAP
    points = floor(99)
    inner = [np.abs(points[:, axis] - edge) < 0.1 for axis, bounds in enumerate(RUG) for edge in bounds]
    within = np.logical_and.reduce(
        [(low - 0.1 < points[:, axis]) & (points[:, axis] < high + 0.1) for axis, (low, high) in enumerate(RUG)]
    )
    edge = np.logical_or.reduce(inner) & within
    assert gaps(adapted, points[edge]).mean() < 0.7 * gaps(centres, points[edge]).mean()
    assert gaps(adapted, points).max() < 1.5 * spacing


def test_where_labels_change_everywhere_the_spacing_stays_even() -> None:
    centres, spacing = even()

    def noise() -> Iterable[ColumnedPoints]:
        random = np.random.default_rng(0)
        return ((points, random.integers(0, 2, len(points))) for points, _ in views(0))

    assert adapted_centres(noise, centres, spacing, 2, WANTED, CAP) is centres


def test_points_are_never_denser_than_wanted() -> None:
    centres, spacing = even()
    adapted = adapted_centres(lambda: views(1), centres, spacing, 2, 0.9 * spacing, CAP)
    assert len(adapted) < len(centres)
