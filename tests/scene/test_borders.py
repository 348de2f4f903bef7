"""Black borders of undistorted photos, and the dark things that are none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.scene.view import border_mask

WIDTH, HEIGHT = 640, 480
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def room() -> Picture:
    """A made-up photo: soft shapes, sensor noise, nothing black at its sides."""
    random = np.random.default_rng(0)
    shapes = cv2.resize(random.uniform(60, 230, (6, 8, 3)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.clip(shapes + random.normal(0, 4, shapes.shape), 40, 255).astype(np.uint8)


def as_jpeg(picture: Picture) -> Picture:
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def undistorted(picture: Picture, bend: float) -> tuple[Picture, Mask]:
    """A photo of a lens with this radial distortion, made straight, and where nothing was seen."""
    camera = np.array([[500.0, 0.0, 325.0], [0.0, 500.0, 236.0], [0.0, 0.0, 1.0]])
    lens = np.array([bend, 0.0, 0.0, 0.0])
    # All that was seen stays in the picture, as tools do it that keep every pixel.
    straight, _ = cv2.getOptimalNewCameraMatrix(camera, lens, (WIDTH, HEIGHT), 1) if bend < 0 else (camera, None)
    seen = cv2.undistort(np.full((HEIGHT, WIDTH), 255, np.uint8), camera, lens, None, straight)
    return np.asarray(cv2.undistort(picture, camera, lens, None, straight), np.uint8), seen == 0


@pytest.mark.parametrize("bend", [-0.1, 0.1])
def test_an_undistorted_photo(bend: float) -> None:
    """Barrel distortion leaves bows along the sides, pincushion distortion wedges in the corners."""
    photo, unseen = undistorted(room(), bend)
    assert 0.02 < unseen.mean() < 0.1
    found = border_mask(as_jpeg(photo))
    assert found[unseen].mean() > 0.95
    near = cv2.dilate(unseen.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0
    assert not found[~near].any()


@pytest.mark.parametrize("thick", [1, 24])
def test_a_straight_bar_and_the_seam_beside_it(thick: int) -> None:
    for turns in range(4):
        photo, expected = room(), np.zeros((HEIGHT, WIDTH), bool)
        np.rot90(photo, turns)[:thick] = 0
        np.rot90(expected, turns)[: thick + 2] = True
        np.testing.assert_array_equal(border_mask(photo), expected)


def dark_cupboard() -> Picture:
    """Black, but a real surface: noise, and some light in it."""
    photo = room()
    random = np.random.default_rng(1)
    photo[HEIGHT - 40 :, 100:400] = random.normal(6, 2, (40, 300, 3)).clip(0, 12).astype(np.uint8)
    return photo


def deep_shadow() -> Picture:
    """Black without any light, but it reaches far into the picture."""
    photo = room()
    photo[HEIGHT // 2 :, :300] = 0
    return photo


def plant() -> Picture:
    """Black leaves at the upper edge: thin, but ragged."""
    photo = room()
    for column, length in enumerate(np.random.default_rng(2).integers(1, 40, 300).tolist(), start=200):
        photo[:length, column] = 0
    return photo


DARK = {
    "a room": lambda: as_jpeg(room()),
    "a cupboard": dark_cupboard,
    "a shadow": deep_shadow,
    "leaves": plant,
    "a covered lens": lambda: np.zeros((HEIGHT, WIDTH, 3), np.uint8),
}


@pytest.mark.parametrize("picture", DARK)
def test_dark_things_are_not_a_border(picture: str) -> None:
    assert not border_mask(DARK[picture]()).any()
