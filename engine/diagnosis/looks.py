"""The frames that a diagnosis looks at, at most 120 of a scene, and the pairs of them that it compares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera, Frame

MOST_LOOKS = 120
_SPREAD = 24
_GROUP = 5
_NEXT = 3
_WIDEST = 640
_POINTS = 400
_SMOOTH = 1.05
"""Largest ratio of the depths around a point: beyond it the pixels lie on both sides of an edge."""


@dataclass(frozen=True, eq=False)
class Look:
    """A frame whose depth is loaded. ``number`` is its place in the scene's frames.

    ``depth`` float32 [H, W] metres as the scene has it, 0 = none; ``camera`` is of its size. ``points`` int32 [N, 2]
    are (column, row) of pixels on smooth surfaces, spread over the picture, which are compared with other views.
    """

    number: int
    frame: Frame
    camera: Camera
    depth: NDArray[np.float32]
    points: NDArray[np.int32]


def chosen_numbers(count: int) -> list[int]:
    """Which of ``count`` frames are looked at: all, or 24 places spread over the recording with the frames that follow
    them: near views tell small errors, far ones that see the same tell large ones.
    """
    if count <= MOST_LOOKS:
        return [*range(count)]
    starts = np.linspace(0, count - 1, _SPREAD).round().astype(int)
    steps = np.cumsum([0, 1, 2, 4, 8])[:_GROUP]
    return sorted({int(min(start + step, count - 1)) for start in starts for step in steps})


def pairs_of(count: int) -> NDArray[np.int64]:
    """The pairs (from, to) that are compared, int64 [P, 2]: each look with the next three, 24 looks with each other."""
    spread = np.unique(np.linspace(0, count - 1, min(count, _SPREAD)).round().astype(int)).tolist()
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _NEXT, count))}
    pairs |= {*combinations(spread, 2)}
    # Either direction in turn: each frame's points are looked at, and its depth is.
    return np.array([(i, j) if (i + j) % 2 else (j, i) for i, j in sorted(pairs)], np.int64).reshape(-1, 2)


def load_looks(frames: Sequence[Frame]) -> list[Look]:
    """Load the depth of the chosen frames that have any. Raises SceneError for files that are bad."""
    looks = []
    for number in chosen_numbers(len(frames)):
        look = None if frames[number].read_depth is None else _load(number, frames[number])
        if look is not None:
            looks.append(look)
    return looks


def _load(number: int, frame: Frame) -> Look | None:
    depth = frame.depth(None)
    depth = thinned(depth, stride_for(depth.shape[1]))
    height, width = depth.shape
    points = _smooth_points(depth, np.random.default_rng(number))
    return Look(number, frame, frame.camera.resized(width, height), depth, points) if len(points) else None


def stride_for(width: int) -> int:
    """The odd step between pixels that brings a picture's width to 640 at most."""
    step = -(-width // _WIDEST)
    return step + 1 - step % 2


def thinned(pixels: NDArray[np.float32], step: int) -> NDArray[np.float32]:
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
