"""Each tile's list, by one worker or by several: the same Gaussians, front to back, each in a slot of its own."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from engine.raster import isect_tiles as listing
from engine.raster.arrays import Intersections
from engine.raster.conventions import TILE
from engine.raster.isect_tiles import blending_workers, isect_tiles

WIDTH, HEIGHT = 90, 50
COLUMNS, ROWS = -(-WIDTH // TILE), -(-HEIGHT // TILE)


class Boxes(NamedTuple):
    """What projection makes of Gaussians, as the arguments of ``isect_tiles``."""

    boxes: NDArray[np.int32]
    depths: NDArray[np.float32]


def projected(count: int, seed: int) -> Boxes:
    """Boxes of tiles anywhere in the image, some of them empty; depths of which many are equal."""
    random = np.random.default_rng(seed)
    ends = np.sort(random.integers(0, [[COLUMNS + 1], [ROWS + 1]], (count, 2, 2)), axis=2)
    depths = random.choice(np.geomspace(0.02, 300.0, 40).astype(np.float32), count)
    return Boxes(ends.reshape(count, 4).astype(np.int32), depths)


def assert_lists_of_a_stable_sort(listed: tuple[Intersections, int], given: Boxes) -> None:
    lists, longest = listed
    left, right, top, bottom = given.boxes.T
    order = np.argsort(given.depths, kind="stable")
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


@pytest.fixture(params=[0, 10**9])
def worth_sharing(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scattering is shared, or not."""
    monkeypatch.setattr(listing, "WORTH_SHARING", request.param)


@pytest.mark.usefixtures("worth_sharing")
@pytest.mark.parametrize("workers", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 700])
def test_tile_lists_match_a_stable_sort(count: int, workers: int) -> None:
    given = projected(count, seed=count)
    assert_lists_of_a_stable_sort(isect_tiles(workers, *given, WIDTH, HEIGHT), given)
