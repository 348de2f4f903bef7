"""Are the frames in the order of their recording, and are some there twice?"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import Frame

Floats = NDArray[np.float64]

LEAST_FRAMES = 12
_MOST = 1500
"""Frames whose order is looked at: the distances of all to all are needed."""
_REACH = 2.0
"""Metres to what a camera looks at: a turn moves that by so much, and the camera's own motion adds to it."""


class Order(NamedTuple):
    """Steps between frames that follow each other, in metres that what they look at moves by.

    ``given``: the median in the order of the names. ``shortest``: in an order found by going to the nearest frame.
    ``rank``: how many frames, in the median and as a share of all, are nearer to a frame than the next one is.
    ``smoothness``: the mean cosine between steps that follow each other in the order found: 1 on a straight path, 0
    among places at random. ``path`` is that order.
    """

    given: float
    shortest: float
    rank: float
    smoothness: float
    path: tuple[int, ...]

    @property
    def is_shuffled(self) -> bool:
        """Whether a smooth recording was taken apart. Views from places at random have no better order, but also no
        smooth path through them.
        """
        return self.rank > 1 / 6 and self.shortest * 4.0 < self.given and self.smoothness > 0.5


def measure_order(poses: Floats) -> Order | None:
    """The order of cameras, float64 [F, 4, 4]; None where there are too few, or far too many."""
    count = len(poses)
    if not LEAST_FRAMES <= count <= _MOST:
        return None
    places = np.concatenate([poses[:, :3, 3] + _REACH * poses[:, :3, 2], poses[:, :3, 3]], axis=1)
    squares = (places**2).sum(1)
    distances = np.sqrt(np.maximum(squares[:, None] + squares[None] - 2.0 * places @ places.T, 0.0) / 2.0)
    np.fill_diagonal(distances, np.inf)
    steps = distances[np.arange(count - 1), np.arange(1, count)]
    nearer = (distances[:-1] < steps[:, None]).sum(1)
    path = _path(distances)
    found = distances[path[:-1], path[1:]]
    return Order(
        float(np.median(steps)), float(np.median(found)), float(np.median(nearer)) / count,
        _smoothness(places[path]), tuple(path),
    )  # fmt: skip


def _path(distances: Floats) -> list[int]:
    """From frame to nearest frame, begun at an end: the frame farthest from where a first walk began."""
    return _walk(distances, _walk(distances, 0)[-1])


def _walk(distances: Floats, start: int) -> list[int]:
    left = distances.copy()
    path = [start]
    for _ in range(len(distances) - 1):
        left[:, path[-1]] = np.inf
        path.append(int(left[path[-1]].argmin()))
    return path


def _smoothness(places: Floats) -> float:
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    moving = (lengths[1:] > 1e-9) & (lengths[:-1] > 1e-9)
    cosines = (steps[1:] * steps[:-1]).sum(1)[moving] / (lengths[1:] * lengths[:-1])[moving]
    return float(np.median(cosines)) if len(cosines) else 0.0


def repeated_frames(frames: Sequence[Frame]) -> list[tuple[int, int]]:
    """Frames whose picture another one has, byte by byte: (the later, the first), by their numbers.

    Pictures in files of their own alone are looked at. Raises OSError.
    """
    first: dict[bytes, int] = {}
    repeated = []
    for number, frame in enumerate(frames):
        if not frame.file_shows_colour:
            continue
        key = hashlib.blake2b(frame.colour_path.read_bytes(), digest_size=16).digest()
        if key in first:
            repeated.append((number, first[key]))
        else:
            first[key] = number
    return repeated
