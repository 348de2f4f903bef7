"""What is particular to a photo: its exposure and its sharpness."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.train.photos import LARGEST_GAIN, LEAST_WEIGHT, exposure_gains, sharpness_weights


def walk(gains: np.ndarray, seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray], int]:
    """Photos of a coloured wall of 400 points in a row, each of 60 of them, some steps on from the one before; which
    point each pixel shows; and how many points there are. ``gains`` [N, 3]."""
    random = np.random.default_rng(seed)
    wall = random.uniform(40, 110, (400, 3))
    starts = np.linspace(0, 340, len(gains)).astype(int)
    rows = [np.repeat(np.arange(start, start + 60, dtype=np.int32)[None], 8, 0) for start in starts]
    shown = [gain * wall[row] + random.normal(0, 1, (*row.shape, 3)) for gain, row in zip(gains, rows, strict=True)]
    return [np.clip(np.round(each), 0, 255).astype(np.uint8) for each in shown], rows, 400


GAIN = st.floats(0.6, 1.6)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(GAIN, GAIN, GAIN), min_size=15, max_size=25), st.integers(0, 99))
def test_exposure_gains_are_found_in_each_channel(gains: list[tuple[float, float, float]], seed: int) -> None:
    true = np.array(gains)
    found = exposure_gains(*walk(true, seed))
    np.testing.assert_allclose(found, true / np.exp(np.log(true).mean(axis=0)), rtol=0.03)


def test_highlights_do_not_make_a_photo_count_as_overexposed() -> None:
    photos_, rows, points = walk(np.ones((20, 3)))
    photos_[7][:, :12] = 235
    np.testing.assert_allclose(exposure_gains(photos_, rows, points), 1, rtol=0.03)


def test_exposure_gains_ignore_black_borders() -> None:
    photos_, rows, points = walk(np.ones((20, 3)))
    photos_[3][:4] = 0
    rows[5][:] = -1
    np.testing.assert_allclose(exposure_gains(photos_, rows, points), 1, rtol=0.02)


def test_exposure_gains_have_limits() -> None:
    gains = np.ones((20, 3))
    gains[10:] = 0.12
    found = exposure_gains(*walk(gains))
    assert found.min() >= 1 / LARGEST_GAIN and found.max() <= LARGEST_GAIN


def photos(count: int) -> list[np.ndarray]:
    """Nearly the same picture again and again, as neighbouring photos are."""
    random = np.random.default_rng(0)
    room = cv2.resize(random.uniform(30, 220, (30, 50, 3)), (200, 120), interpolation=cv2.INTER_CUBIC)
    windows = [room[:, i : i + 160] for i in range(count)]
    return [np.clip(each + random.normal(0, 2, each.shape), 0, 255).astype(np.uint8) for each in windows]


def test_a_blurred_photo_has_less_weight_in_training() -> None:
    sharp = photos(9)
    assert (sharpness_weights(sharp) > 0.9).all()
    blurred = [*sharp[:4], cv2.blur(sharp[4], (15, 1)), *sharp[5:]]
    weights = sharpness_weights(blurred)
    assert weights[4] < 0.5 and (np.delete(weights, 4) > 0.9).all() and weights.max() <= 1
    worse = sharpness_weights([*sharp[:4], cv2.blur(sharp[4], (41, 41)), *sharp[5:]])
    assert worse[4] == pytest.approx(LEAST_WEIGHT)


def test_a_photos_exposure_does_not_change_its_measured_blur() -> None:
    sharp = photos(9)
    weights = sharpness_weights([*sharp[:4], (0.4 * sharp[4]).astype(np.uint8), *sharp[5:]])
    assert (weights > 0.85).all()


def test_blur_is_measured_against_neighbouring_photos_only() -> None:
    """Half of the walk passes plain walls: there is less to see there, and nothing is wrong with the photos."""
    plain = [cv2.blur(photo, (9, 9)) for photo in photos(10)]
    weights = sharpness_weights([*photos(10), *plain])
    assert (weights[:9] > 0.9).all() and (weights[-5:] > 0.9).all()
    assert sharpness_weights([]).shape == (0,) and sharpness_weights(plain[:1]).tolist() == [1.0]


def test_black_photos_have_a_valid_training_weight() -> None:
    assert sharpness_weights([np.zeros((8, 8, 3), np.uint8)] * 3).min() >= LEAST_WEIGHT
