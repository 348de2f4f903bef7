from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from engine.scene.pixels import (
    decode,
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


def test_colour_is_averaged_when_shrunk_and_stays_in_place_when_enlarged() -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[:2, :2] = 200
    small = resize_colour(pixels, (3, 2))
    assert small[0, 0, 0] == 200 and small[1, 2, 0] == 0
    large = resize_colour(np.tile(np.arange(0, 240, 8, dtype=np.uint8)[None, :, None], (6, 1, 3)), (60, 12))
    assert abs(int(large[6, 20:40].mean()) - 116) <= 2


def test_an_image_with_sound_chunks_and_no_pixels_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((4, 4), np.uint8))
    data = (tmp_path / "image.png").read_bytes()
    start = data.index(b"IDAT") - 4
    (tmp_path / "image.png").write_bytes(data[:start] + data[data.index(b"IEND") - 4 :])
    with raises_key("undecodable"):
        decode(tmp_path / "image.png", as_colour=False)
