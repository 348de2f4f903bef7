"""Each tile's list, by one worker or by several: the same Gaussians, front to back, each in a slot of its own."""

import math

import numpy as np
import pytest

from engine.raster import isect_tiles as listing
from engine.raster.conventions import TILE
from engine.raster.isect_tiles import blending_workers, isect_tiles

WIDTH, HEIGHT = 90, 50
COLUMNS, ROWS = -(-WIDTH // TILE), -(-HEIGHT // TILE)


@pytest.mark.parametrize("worth_sharing", [0, 10**9])
@pytest.mark.parametrize("workers", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 700])
def test_gaussians_of_each_tile_are_in_the_order_of_a_stable_sort(
    count: int, workers: int, worth_sharing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boxes of tiles anywhere in the image. Some boxes are empty, and many depths are equal. The scattering is
    shared, or not."""
    monkeypatch.setattr(listing, "WORTH_SHARING", worth_sharing)
    random = np.random.default_rng(count)
    ends = np.sort(random.integers(0, [[COLUMNS + 1], [ROWS + 1]], (count, 2, 2)), axis=2)
    depths = random.choice(np.geomspace(0.02, 300.0, 40).astype(np.float32), count)
    boxes = ends.reshape(count, 4).astype(np.int32)
    lists, longest = isect_tiles(workers, boxes, depths, WIDTH, HEIGHT)
    left, right, top, bottom = boxes.T
    order = np.argsort(depths, kind="stable")
    lengths = []
    for tile in range(COLUMNS * ROWS):
        column, row = tile % COLUMNS, tile // COLUMNS
        inside = (left <= column) & (column < right) & (top <= row) & (row < bottom)
        own = slice(lists.isect_offsets[tile], lists.isect_offsets[tile + 1])
        assert np.array_equal(lists.flatten_ids[own], order[inside[order]])
        owners = np.searchsorted(lists.gaussian_offsets, lists.isect_ids[own], side="right") - 1
        assert np.array_equal(owners, lists.flatten_ids[own])
        lengths.append(int(inside.sum()))
    assert longest == max(lengths)
    assert np.array_equal(np.sort(lists.isect_ids), np.arange(sum(lengths)))
    assert blending_workers(10**6, lists, longest) == max(1, math.ceil(sum(lengths) / max(1, max(lengths))))
