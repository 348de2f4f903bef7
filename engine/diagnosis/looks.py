"""What is loaded for a diagnosis: depth ("looks") and photos of at most 120 frames, and which looks are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera, Frame

Floats = NDArray[np.float64]

_MOST_LOOKS = 120
_SPREAD = 24
"""Places in the recording that are compared with each other. Each has a group of frames."""
_GROUP_STEPS = (0, 1, 3, 7, 15)
"""Frames of a group, counted from its first."""
_NEXT = 3
"""The number of following looks, in recording order, that each look is compared with."""
_WIDEST = 640
"""The width in pixels to which depth and pictures are reduced."""
_PHOTO_WIDTH = 320
_POINTS = 400
"""The number of points that each look compares with other views."""
_SMOOTH = 1.05
"""Largest ratio of the depths around a point. Above it, the pixels lie on both sides of an edge."""
_DARK, _BRIGHT = 8, 247
"""Grey levels below and above which a pixel is clipped."""


@dataclass(frozen=True, eq=False)
class Look:
    """A frame whose depth is loaded. ``number`` is its place in the scene's frames.

    ``depth`` float32 [H, W] is in the scene's metres, 0 = none; ``camera`` has its size. ``points`` int32 [N, 2]
    (column, row) lie on smooth surfaces, spread over the picture. They are compared with other views.
    """

    number: int
    frame: Frame
    camera: Camera
    depth: NDArray[np.float32]
    points: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Photo:
    """A frame's picture. ``grey`` uint8 [H, W] is at most 320 pixels wide."""

    number: int
    name: str
    grey: NDArray[np.uint8]

    @property
    def clipped(self) -> float:
        """The share of pixels that are black or white."""
        return float(((self.grey < _DARK) | (self.grey > _BRIGHT)).mean())


def chosen_numbers(count: int) -> list[int]:
    """Which of ``count`` frames are examined: all, or 24 groups spread over the recording.

    Neighbours show small errors. Distant views of the same surface show large ones.
    """
    if count <= _MOST_LOOKS:
        return [*range(count)]
    starts = np.linspace(0, count - 1, _SPREAD).round().astype(int)
    return sorted({int(min(start + step, count - 1)) for start in starts for step in _GROUP_STEPS})


def pairs_of(count: int) -> NDArray[np.int64]:
    """The pairs (from, to) that are compared, int64 [P, 2]: each look with the next three, 24 looks with each other."""
    spread = np.unique(np.linspace(0, count - 1, min(count, _SPREAD)).round().astype(int)).tolist()
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _NEXT, count))}
    pairs |= {*combinations(spread, 2)}
    # Directions alternate, so that both the points and the depth of each look are used.
    return np.array([(i, j) if (i + j) % 2 else (j, i) for i, j in sorted(pairs)], np.int64).reshape(-1, 2)


def load_looks(frames: Sequence[Frame]) -> list[Look]:
    """Load the depth of the chosen frames that have depth. Raises PlgsError for bad files."""
    with_depth = [number for number in chosen_numbers(len(frames)) if frames[number].read_depth is not None]
    return [look for number in with_depth if (look := _load_look(number, frames[number])) is not None]


def _load_look(number: int, frame: Frame) -> Look | None:
    depth = frame.depth(None)
    depth = _thinned(depth, _stride_for(depth.shape[1]))
    height, width = depth.shape
    points = _smooth_points(depth, np.random.default_rng(number))
    return Look(number, frame, frame.camera.resized(width, height), depth, points) if len(points) else None


def load_photos(frames: Sequence[Frame]) -> dict[int, Photo]:
    """The pictures of the chosen frames, by the frames' numbers. Raises PlgsError."""
    return {number: _load_photo(number, frames[number]) for number in chosen_numbers(len(frames))}


def _load_photo(number: int, frame: Frame) -> Photo:
    import cv2

    grey = cv2.cvtColor(frame.read_colour(None), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    step = _stride_for(width)
    if step > 1:
        grey = cv2.resize(grey, (width // step, height // step), interpolation=cv2.INTER_AREA)
    height, width = grey.shape
    if width > _PHOTO_WIDTH:
        size = (_PHOTO_WIDTH, round(height * _PHOTO_WIDTH / width))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return Photo(number, frame.name, grey.astype(np.uint8))


def values_at(pixels: NDArray[Any], places: Floats) -> NDArray[Any]:
    """The pixels of an array [H, W] at places, float64 [N, 2], in shares of its width and height."""
    height, width = pixels.shape
    columns = np.clip((places[:, 0] * width).astype(np.int64), 0, width - 1)
    rows = np.clip((places[:, 1] * height).astype(np.int64), 0, height - 1)
    return pixels[rows, columns]


def _stride_for(width: int) -> int:
    """The odd step between pixels that reduces a picture to at most 640 across."""
    step = -(-width // _WIDEST)
    return step + 1 - step % 2


def _thinned(pixels: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Every ``step``-th (odd) row and column: the middle pixel of each block, so that nothing moves by half a pixel."""
    if step == 1:
        return pixels
    height, width = pixels.shape
    rows = np.arange(height // step) * step + step // 2
    columns = np.arange(width // step) * step + step // 2
    return np.ascontiguousarray(pixels[rows[:, None], columns])


def _smooth_points(depth: NDArray[np.float32], random: np.random.Generator) -> NDArray[np.int32]:
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    nearest, farthest = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    smooth = (nearest > 0.0) & (farthest < _SMOOTH * nearest)
    smooth[[0, -1]] = smooth[:, [0, -1]] = False
    rows, columns = np.nonzero(smooth)
    chosen = random.permutation(len(rows))[:_POINTS]
    return np.stack([columns[chosen], rows[chosen]], axis=-1).astype(np.int32)
