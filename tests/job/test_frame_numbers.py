"""Frames as studios number them."""

from __future__ import annotations

import pytest

from engine.job.cameras import frame_numbers


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("1001", [1001]),
        ("1001,1003", [1001, 1003]),
        ("10-16:2", [10, 12, 14, 16]),
        ("10-16x3, 7", [10, 13, 16, 7]),
        ("0003-0005", [3, 4, 5]),
        ("-3-1", [-3, -2, -1, 0, 1]),
        ("-3--1:2, -7", [-3, -1, -7]),
    ],
)
def test_lists_and_ranges(text: str, frames: list[int]) -> None:
    assert [frame for each in frame_numbers(text) for frame in each] == frames


@pytest.mark.parametrize("text", ["", "1-", "5-1", "1-5:0", "a", "1;2", "-3--5", "--3", "1,,2"])
def test_what_is_no_list_of_frames_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="such as|looks like"):
        frame_numbers(text)
