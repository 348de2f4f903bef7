"""Portions of Gaussians: each one in one of them, and none that is not worth a worker's while."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from engine.raster.portions import MOST_PORTIONS, PORTION, portion_count, range_of


@given(st.one_of(st.integers(0, 3 * PORTION), st.integers(0, 10**7)))
def test_every_gaussian_is_in_one_portion(count: int) -> None:
    portions = portion_count(count)
    ranges = [range_of(portion, portions, count) for portion in range(portions)]
    assert ranges[0][0] == 0 and ranges[-1][1] == count
    assert all(end == first for (_, end), (first, _) in zip(ranges, ranges[1:], strict=False))
    assert 1 <= portions <= MOST_PORTIONS
    assert portions == 1 or all(end - first >= PORTION // 2 for first, end in ranges)


@given(st.integers(0, 10**7), st.integers(0, 20))
def test_who_comes_too_late_gets_none(count: int, later: int) -> None:
    portions = portion_count(count)
    assert range_of(portions - 1, portions, count)[1] == count
    first, end = range_of(portions + later, portions, count)
    assert first >= min(end, count)
