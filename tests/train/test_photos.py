"""What is particular to a photo: its exposure and its sharpness."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.train.photos import LARGEST_GAIN, LEAST_WEIGHT, exposure_gain, sharpness_weights

PICTURE = torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(0))
GAIN = st.floats(1.01 / LARGEST_GAIN, 0.99 * LARGEST_GAIN)


@settings(max_examples=30, deadline=None)
@given(st.tuples(GAIN, GAIN, GAIN))
def test_a_gain_is_found_in_each_channel(gain: tuple[float, float, float]) -> None:
    photo = (PICTURE * torch.tensor(gain)).numpy()
    np.testing.assert_allclose(exposure_gain(PICTURE, photo, None), gain, rtol=1e-4)


def test_the_border_does_not_make_a_photo_dark() -> None:
    photo = (1.5 * PICTURE).numpy()
    border = torch.zeros(20, 24, dtype=torch.bool)
    border[:6] = True
    photo[:6] = 0
    np.testing.assert_allclose(exposure_gain(PICTURE, photo, border), 1.5, rtol=1e-5)
    assert (exposure_gain(PICTURE, photo, None) < 1.3).all()


def test_gains_have_limits_and_no_gradient() -> None:
    image = PICTURE.clone().requires_grad_()
    assert not exposure_gain(image, PICTURE.numpy(), None).requires_grad
    for factor, expected in ((100.0, LARGEST_GAIN), (0.0, 1 / LARGEST_GAIN)):
        np.testing.assert_allclose(exposure_gain(PICTURE, (factor * PICTURE).numpy(), None), expected, rtol=1e-6)


def photos(count: int) -> list[np.ndarray]:
    """Nearly the same picture again and again, as neighbouring photos are."""
    random = np.random.default_rng(0)
    room = cv2.resize(random.uniform(30, 220, (30, 50, 3)), (200, 120), interpolation=cv2.INTER_CUBIC)
    windows = [room[:, i : i + 160] for i in range(count)]
    return [np.clip(each + random.normal(0, 2, each.shape), 0, 255).astype(np.uint8) for each in windows]


def test_a_blurred_photo_counts_less() -> None:
    sharp = photos(9)
    assert (sharpness_weights(sharp) > 0.9).all()
    blurred = [*sharp[:4], cv2.blur(sharp[4], (15, 1)), *sharp[5:]]
    weights = sharpness_weights(blurred)
    assert weights[4] < 0.5 and (np.delete(weights, 4) > 0.9).all() and weights.max() <= 1
    worse = sharpness_weights([*sharp[:4], cv2.blur(sharp[4], (41, 41)), *sharp[5:]])
    assert worse[4] == pytest.approx(LEAST_WEIGHT)


def test_exposure_does_not_make_a_photo_blurred() -> None:
    sharp = photos(9)
    weights = sharpness_weights([*sharp[:4], (0.4 * sharp[4]).astype(np.uint8), *sharp[5:]])
    assert (weights > 0.85).all()


def test_a_photo_is_compared_with_its_neighbours_only() -> None:
    """Half of the walk passes plain walls: there is less to see there, and nothing is wrong with the photos."""
    plain = [cv2.blur(photo, (9, 9)) for photo in photos(10)]
    weights = sharpness_weights([*photos(10), *plain])
    assert (weights[:9] > 0.9).all() and (weights[-5:] > 0.9).all()
    assert sharpness_weights([]).shape == (0,) and sharpness_weights(plain[:1]).tolist() == [1.0]


def test_black_photos_count() -> None:
    assert sharpness_weights([np.zeros((8, 8, 3), np.uint8)] * 3).min() >= LEAST_WEIGHT
