"""Each tile's list, by one worker or by several: the same Gaussians, front to back, each in a slot of its own."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from engine.raster import isect_tiles as listing
from engine.raster.arrays import Intersections
from engine.raster.conventions import TILE
from engine.raster.isect_tiles import CHUNK, MOST_CHUNKS, blending_workers, chunk_count, chunk_range, isect_tiles

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


@pytest.mark.parametrize(("count", "pairs", "sharing"), [(10, 10, 1), (10, 1000, 2), (1000, 0, 1)])
def test_few_intersections_are_scattered_by_one_worker(
    count: int, pairs: int, sharing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes = np.zeros((count, 4), np.int32)
    boxes[: count if pairs else 0] = [0, 10, 0, pairs // count // 10] if pairs > count else [0, 1, 0, 1]
    shares: list[int] = []
    own = listing.parallel_for
    monkeypatch.setattr(listing, "parallel_for", lambda workers, *rest: (shares.append(workers), own(workers, *rest)))
    listed, _ = isect_tiles(2, boxes, np.ones(count, np.float32), 10 * TILE, 10 * TILE)
    assert len(listed.flatten_ids) == pairs and shares == [sharing, sharing]


@given(st.one_of(st.integers(0, 3 * CHUNK), st.integers(0, 10**7)))
def test_every_gaussian_is_in_one_chunk(count: int) -> None:
    chunks = chunk_count(count)
    ranges = [chunk_range(chunk, chunks, count) for chunk in range(chunks)]
    assert ranges[0][0] == 0 and ranges[-1][1] == count
    assert all(end == first for (_, end), (first, _) in zip(ranges, ranges[1:], strict=False))
    assert 1 <= chunks <= MOST_CHUNKS
    assert chunks == 1 or all(end - first >= CHUNK // 2 for first, end in ranges)


@given(st.integers(0, 10**7), st.integers(0, 20))
def test_range_after_the_last_chunk_is_empty(count: int, later: int) -> None:
    chunks = chunk_count(count)
    assert chunk_range(chunks - 1, chunks, count)[1] == count
    first, end = chunk_range(chunks + later, chunks, count)
    assert first >= min(end, count)
