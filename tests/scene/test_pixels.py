from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.scene import Category, ClassTable, PanopticMask, Segment
from engine.scene.frame_colours import depth_colours, mask_colours
from engine.scene.pixels import decode, resize_colour, resize_nearest
from tests.raises_key import raises_key

sizes = st.tuples(st.integers(1, 30), st.integers(1, 30))


def numbered(size: tuple[int, int]) -> np.ndarray:
    return np.arange(size[0] * size[1], dtype=np.int32).reshape(size[1], size[0])


@given(sizes, sizes)
def test_nearest_resizing_takes_the_pixel_under_the_centre(size: tuple[int, int], target: tuple[int, int]) -> None:
    resized = resize_nearest(numbered(size), target)
    assert resized.shape == target[::-1]
    for i, j in ((0, 0), (target[0] - 1, target[1] - 1), (target[0] // 2, target[1] // 2)):
        column = int((i + 0.5) * size[0] / target[0] + 1e-9)
        row = int((j + 0.5) * size[1] / target[1] + 1e-9)
        assert resized[j, i] == row * size[0] + column


def test_resized_colour_is_averaged_and_stays_in_place() -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[:2, :2] = 200
    small = resize_colour(pixels, (3, 2))
    assert small[0, 0, 0] == 200 and small[1, 2, 0] == 0
    large = resize_colour(np.tile(np.arange(0, 240, 8, dtype=np.uint8)[None, :, None], (6, 1, 3)), (60, 12))
    assert abs(int(large[6, 20:40].mean()) - 116) <= 2


def test_a_png_without_pixels_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((4, 4), np.uint8))
    data = (tmp_path / "image.png").read_bytes()
    start = data.index(b"IDAT") - 4
    (tmp_path / "image.png").write_bytes(data[:start] + data[data.index(b"IEND") - 4 :])
    with raises_key("undecodable"):
        decode(tmp_path / "image.png", as_colour=False)


CLASSES = ClassTable((Category(1, "wall", False, (200, 180, 160)), Category(7, "chair", True, (20, 90, 200))))


def test_depth_pictures_show_near_light_far_dark_and_none_grey() -> None:
    depth = np.tile(np.linspace(1.05, 1.95, 100, dtype=np.float32), (4, 1))
    depth[0] = 0.0
    drawn = depth_colours(depth)
    brightness = drawn.rgb.astype(int).sum(-1)
    assert (brightness[0] == 180).all() and (np.diff(brightness[2]) <= 0).all()
    assert brightness[2, 0] > 3 * brightness[2, -1]
    assert 1.049 < drawn.near < 1.1 and 1.9 < drawn.far < 1.951


def test_depth_pictures_have_a_line_at_each_metre() -> None:
    depth = np.tile(np.linspace(0.55, 3.45, 59, dtype=np.float32), (3, 1))  # steps of 5 cm
    brightness = depth_colours(depth).rgb[1].astype(int).sum(-1)
    dips = [i for i in range(1, 58) if brightness[i] < 0.7 * brightness[i + 1]]
    assert [round(float(depth[1, i + 1])) for i in dips] == [1, 2, 3]


@pytest.mark.parametrize("metres", [0.0, 2.0])
def test_depth_pictures_without_any_difference_are_one_colour(metres: float) -> None:
    drawn = depth_colours(np.full((4, 4), metres, np.float32))
    assert drawn.near == drawn.far == metres and len(np.unique(drawn.rgb.reshape(-1, 3), axis=0)) == 1


def test_mask_pictures_show_class_colours_with_borders() -> None:
    ids = np.zeros((6, 8), np.int32)
    ids[:, 2:5], ids[:, 5:] = 3, 9
    mask = PanopticMask(ids, (Segment(3, 1, False), Segment(9, 7, True)))
    drawn = mask_colours(mask, CLASSES)
    assert drawn[2, 3].tolist() == [200, 180, 160] and drawn[2, 6].tolist() == [20, 90, 200]
    assert drawn[2, 0].tolist() == [60, 60, 60], "void"
    assert drawn[2, 4].tolist() == [80, 72, 64], "the border of two segments"
    unknown = PanopticMask(np.full((2, 2), 4, np.int32), (Segment(4, 99, True),))
    assert (mask_colours(unknown, CLASSES) == 60).all(), "a class that the table lacks"
