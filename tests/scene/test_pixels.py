from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.scene.pixels import (
    Alignment,
    decode,
    decode_single_channel,
    distinct_ids,
    resize_aligned,
    resize_colour,
    resize_nearest,
)
from tests.raises_key import raises_key

sizes = st.tuples(st.integers(1, 30), st.integers(1, 30))


def numbered(size: tuple[int, int]) -> np.ndarray:
    return np.arange(size[0] * size[1], dtype=np.int32).reshape(size[1], size[0])


@given(sizes, sizes)
def test_nearest_takes_the_pixel_that_the_centre_falls_in(size: tuple[int, int], target: tuple[int, int]) -> None:
    resized = resize_nearest(numbered(size), target)
    assert resized.shape == target[::-1]
    for i, j in ((0, 0), (target[0] - 1, target[1] - 1), (target[0] // 2, target[1] // 2)):
        column = int((i + 0.5) * size[0] / target[0] + 1e-9)
        row = int((j + 0.5) * size[1] / target[1] + 1e-9)
        assert resized[j, i] == row * size[0] + column


@given(sizes, st.integers(1, 5))
def test_nearest_enlarged_by_a_whole_factor_shrinks_back_unchanged(size: tuple[int, int], factor: int) -> None:
    pixels = numbered(size)
    large = resize_nearest(pixels, (size[0] * factor, size[1] * factor))
    np.testing.assert_array_equal(large, np.kron(pixels, np.ones((factor, factor), np.int32)))
    np.testing.assert_array_equal(resize_nearest(large, size), pixels)


def test_an_alignment_shifts_depth_and_leaves_a_gap_at_the_edge() -> None:
    pixels = numbered((8, 4)) + 1
    shifted = resize_aligned(pixels, (8, 4), Alignment(x_shift=0.25))
    np.testing.assert_array_equal(shifted[:, :6], pixels[:, 2:])
    assert not shifted[:, 6:].any() and shifted.dtype == pixels.dtype


def test_colour_is_averaged_when_shrunk_and_stays_in_place_when_enlarged() -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[:2, :2] = 200
    small = resize_colour(pixels, (3, 2))
    assert small[0, 0, 0] == 200 and small[1, 2, 0] == 0
    large = resize_colour(np.tile(np.arange(0, 240, 8, dtype=np.uint8)[None, :, None], (6, 1, 3)), (60, 12))
    assert abs(int(large[6, 20:40].mean()) - 116) <= 2


def test_colours_come_as_rgb_and_labels_as_they_are(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "colour.png"), np.full((2, 2, 3), (10, 20, 30), np.uint8))
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((2, 2), 40, np.uint8))
    cv2.imwrite(str(tmp_path / "label.png"), np.full((2, 2), 60000, np.uint16))
    assert decode(tmp_path / "colour.png", as_colour=True)[0, 0].tolist() == [30, 20, 10]
    assert decode(tmp_path / "grey.png", as_colour=True)[0, 0].tolist() == [40, 40, 40]
    assert decode_single_channel(tmp_path / "label.png")[0, 0] == 60000
    with raises_key("mask-colours"):
        decode_single_channel(tmp_path / "colour.png")


def test_an_image_with_sound_chunks_and_no_pixels_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((4, 4), np.uint8))
    data = (tmp_path / "image.png").read_bytes()
    start = data.index(b"IDAT") - 4
    (tmp_path / "image.png").write_bytes(data[:start] + data[data.index(b"IEND") - 4 :])
    with raises_key("undecodable"):
        decode(tmp_path / "image.png", as_colour=False)


@pytest.mark.parametrize("highest", [5, 100_000, 256**3 - 1])
def test_distinct_ids_are_numpys_unique(highest: int) -> None:
    ids = np.random.default_rng(0).integers(0, highest + 1, (12, 10)).astype(np.int32)
    values, counts = distinct_ids(ids)
    expected, expected_counts = np.unique(ids, return_counts=True)
    np.testing.assert_array_equal(values, expected)
    np.testing.assert_array_equal(counts, expected_counts)
