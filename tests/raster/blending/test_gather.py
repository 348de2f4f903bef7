"""Label gradients of a chunk of Gaussians, added up in order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from engine.machine.compiled import compiled
from engine.raster.arrays import IsectGradients, TileChannels
from engine.raster.blending.batch import gather_labels
from engine.raster.conventions import TILE

GUARD = 64
UNTOUCHED = np.float32(12345.0)


@compiled
def gather_by_vectors(chunk: Any, offsets: Any, isects: Any, channels: int, d_labels: Any) -> None:
    gather_labels(chunk, offsets, isects, channels, d_labels)


@pytest.mark.parametrize("channels", [0, 1, 2, 5, 7, 8, 15, 16, 17, 46])
def test_gather_writes_only_its_chunk(channels: int) -> None:
    """Tile 0 has a gradient in no channel, tile 3 in all of them."""
    random = np.random.default_rng(channels)
    count, tile_count = 11, 4
    offsets = np.concatenate([[0], np.cumsum(random.integers(0, 4, count))]).astype(np.int64)
    tiles = random.integers(-1, tile_count, offsets[-1]).astype(np.int32)
    of_tile = [np.sort(random.permutation(channels)[: channels * tile // 3]) for tile in range(tile_count)]
    padded = -(-channels // TILE) * TILE
    listed = np.full((tile_count, channels), -1, np.int32)
    for own, row in zip(of_tile, listed, strict=True):
        row[: len(own)] = own
    used = TileChannels(np.array([len(own) for own in of_tile]), listed.ravel(), padded)
    labels = random.normal(size=(offsets[-1], padded)).astype(np.float32)
    isects = IsectGradients(used, tiles, np.empty(0, np.float32), labels.ravel())
    expected = np.zeros((count, channels), np.float32)
    for i in range(count):
        for isect in range(offsets[i], offsets[i + 1]):
            own = of_tile[tiles[isect]] if tiles[isect] >= 0 else of_tile[0]
            expected[i, own] += labels[isect, : len(own)]
    expected = expected.ravel()
    for first, end in ((0, 3), (3, 7), (7, count), (5, 5)):
        got = np.full(count * channels + GUARD, UNTOUCHED)
        gather_by_vectors((first, end), offsets, isects, channels, got)
        own = slice(first * channels, end * channels)
        np.testing.assert_array_equal(got[own], expected[own])
        got[own] = UNTOUCHED
        assert (got == UNTOUCHED).all()
