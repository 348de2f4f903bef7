"""Label gradients of a chunk of Gaussians, added up in order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from engine.machine.compiled import compiled
from engine.raster.arrays import IsectGradients
from engine.raster.blending.batch import gather_labels
from engine.raster.conventions import TILE

GUARD = 64
UNTOUCHED = np.float32(12345.0)


@compiled
def gather_by_vectors(chunk: Any, offsets: Any, isects: Any, channels: int, d_labels: Any) -> None:
    gather_labels(chunk, offsets, isects, channels, d_labels)


@pytest.mark.parametrize("channels", [0, 1, 2, 5, 7, 8, 15, 16, 17, 46])
def test_the_gaussians_of_a_chunk_and_no_others_are_written(channels: int) -> None:
    random = np.random.default_rng(channels)
    count = 11
    offsets = np.concatenate([[0], np.cumsum(random.integers(0, 4, count))]).astype(np.int64)
    touched = (random.random(offsets[-1]) < 0.7).astype(np.uint8)
    labels = random.normal(size=offsets[-1] * (-(-channels // TILE) * TILE)).astype(np.float32)
    isects = IsectGradients(touched, np.empty(0, np.float32), labels)
    rows = labels.reshape(offsets[-1], -1)[:, :channels] if channels else np.empty((offsets[-1], 0), np.float32)
    expected = np.zeros((count, channels), np.float32)
    for i in range(count):
        for isect in np.flatnonzero(touched[offsets[i] : offsets[i + 1]]) + offsets[i]:
            expected[i] += rows[isect]
    expected = expected.ravel()
    for first, end in ((0, 3), (3, 7), (7, count), (5, 5)):
        got = np.full(count * channels + GUARD, UNTOUCHED)
        gather_by_vectors((first, end), offsets, isects, channels, got)
        own = slice(first * channels, end * channels)
        np.testing.assert_array_equal(got[own], expected[own])
        got[own] = UNTOUCHED
        assert (got == UNTOUCHED).all()
