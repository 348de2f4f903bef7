"""What the pictures by themselves say: how sharp and how bright they are, and which are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Frame
from .looks import chosen_numbers, stride_for

_WIDTH = 320
_NEIGHBOURS = 4
DARK, BRIGHT = 8, 247


@dataclass(frozen=True, eq=False)
class Photo:
    """A frame's picture: ``grey`` uint8 [H, W], 320 wide at most. ``detail``: the mean Laplacian over the mean
    brightness of the picture 640 wide at most, so that exposure does not matter.
    """

    number: int
    name: str
    grey: NDArray[np.uint8]
    detail: float

    @property
    def clipped(self) -> float:
        """The share of pixels that are black or white."""
        return float(((self.grey < DARK) | (self.grey > BRIGHT)).mean())


def load_photos(frames: Sequence[Frame]) -> dict[int, Photo]:
    """The pictures of the frames that are looked at, by their numbers. Raises SceneError."""
    return {number: _load(number, frames[number]) for number in chosen_numbers(len(frames))}


def _load(number: int, frame: Frame) -> Photo:
    import cv2

    colour = frame.read_colour(None)
    grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    step = stride_for(width)
    if step > 1:
        grey = cv2.resize(grey, (width // step, height // step), interpolation=cv2.INTER_AREA)
    detail = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean()) / max(float(grey.mean()), 1.0)
    height, width = grey.shape
    if width > _WIDTH:
        grey = cv2.resize(grey, (_WIDTH, round(height * _WIDTH / width)), interpolation=cv2.INTER_AREA)
    return Photo(number, frame.name, grey.astype(np.uint8), detail)


def relative_sharpness(photos: Sequence[Photo]) -> NDArray[np.float64]:
    """Each picture's detail over the median of its neighbours in the recording, which show about the same."""
    detail = np.array([photo.detail for photo in photos])
    return detail / np.maximum([np.median(around) for around in neighbours_of(detail)], 1e-6)


def neighbours_of(values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Of each value in recording order, float64 [N], the four before and the four after it; alone, itself."""
    if len(values) < 2:
        return [values]
    return [
        np.concatenate([values[max(0, i - _NEIGHBOURS) : i], values[i + 1 : i + 1 + _NEIGHBOURS]])
        for i in range(len(values))
    ]
