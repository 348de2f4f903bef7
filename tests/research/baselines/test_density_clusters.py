"""Clusters by density: heaps are found however many there are, and what lies between is noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from research.baselines.density_clusters import NOISE, density_clusters


def heaps(counts: list[int], spread: float = 0.02, seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Heaps on the corners of a cube, and which each point is of."""
    random = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    owner = np.repeat(np.arange(len(counts)), counts)
    order = random.permutation(len(owner))
    points = corners[owner] + random.normal(scale=spread, size=(len(owner), 3))
    return points[order], owner[order]


@pytest.mark.parametrize("counts", [[60, 60], [200, 30, 80], [40, 50, 60, 70, 80]])
def test_dense_groups_are_clusters(counts: list[int]) -> None:
    points, owner = heaps(counts)
    label = density_clusters(points, 15)
    assert label.max() + 1 == len(counts)
    for heap in range(len(counts)):
        found = label[owner == heap]
        known = found[found != NOISE]
        assert len(known) > 0.7 * len(found) and len(set(known.tolist())) == 1


def test_one_heap_may_be_the_only_cluster() -> None:
    points, _ = heaps([100])
    label = density_clusters(points, 60)
    assert set(label.tolist()) == {0}


def test_scattered_points_are_noise() -> None:
    points, owner = heaps([80, 80, 80])
    far = np.random.default_rng(1).uniform(-3, 4, (12, 3))
    label = density_clusters(np.concatenate([points, far]), 20)
    assert label.max() == 2 and (label[len(owner) :] == NOISE).sum() > 9


def test_what_clusters_do_not_depend_on() -> None:
    points, _ = heaps([40, 50, 60])
    label = density_clusters(points, 15)
    assert np.array_equal(density_clusters(7.0 * points - 3.0, 15), label)
    order = np.random.default_rng(2).permutation(len(points))
    moved = density_clusters(points[order], 15)
    pairs = {(int(one), int(other)) for one, other in zip(label[order], moved, strict=True)}
    assert len(pairs) == len({one for one, _ in pairs}) == len({other for _, other in pairs})


@pytest.mark.parametrize("count", [0, 1, 9])
def test_too_few_points(count: int) -> None:
    assert (density_clusters(np.zeros((count, 3)), 10) == NOISE).all()


def test_points_that_coincide() -> None:
    points = np.repeat([[0.0, 0, 0], [1, 1, 1]], 20, axis=0)
    label = density_clusters(points, 10)
    assert label.max() == 1 and len(set(label[:20].tolist())) == 1 and label[0] != label[20]
