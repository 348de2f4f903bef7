"""Chunks of Gaussians: each one in one of them, and none that is not worth a worker's while."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from engine.raster.isect_tiles import CHUNK, MOST_CHUNKS, chunk_count, chunk_range


@given(st.one_of(st.integers(0, 3 * CHUNK), st.integers(0, 10**7)))
def test_every_gaussian_is_in_one_chunk(count: int) -> None:
    chunks = chunk_count(count)
    ranges = [chunk_range(chunk, chunks, count) for chunk in range(chunks)]
    assert ranges[0][0] == 0 and ranges[-1][1] == count
    assert all(end == first for (_, end), (first, _) in zip(ranges, ranges[1:], strict=False))
    assert 1 <= chunks <= MOST_CHUNKS
    assert chunks == 1 or all(end - first >= CHUNK // 2 for first, end in ranges)


@given(st.integers(0, 10**7), st.integers(0, 20))
def test_latecomers_get_no_lease(count: int, later: int) -> None:
    chunks = chunk_count(count)
    assert chunk_range(chunks - 1, chunks, count)[1] == count
    first, end = chunk_range(chunks + later, chunks, count)
    assert first >= min(end, count)
