"""What all parts of a diagnosis look at: loaded once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene import Frame, Scene
from .looks import Look, load_looks, pairs_of
from .photos import Photo, load_photos
from .reprojection import Assumption, Views


@dataclass(frozen=True, eq=False)
class Examined:
    """``looks`` are the frames whose depth is compared, ``pairs`` int64 [P, 2] which with which; ``photos`` by the
    frames' numbers.
    """

    scene: Scene
    looks: list[Look]
    views: Views
    pairs: NDArray[np.int64]
    photos: dict[int, Photo]

    def name(self, row: int) -> str:
        """The name of a look's frame."""
        return self.looks[row].frame.name

    def telling_pair(self, assumed: Assumption) -> tuple[int, int]:
        """Two looks for a picture: they see much in common, and from places as far apart as that allows."""
        comparison = self.views.compare(self.pairs, assumed)
        share = comparison.agrees.sum(1) / np.maximum(comparison.known.sum(1), 1)
        centres = self.views.poses_of(assumed)[:, :3, 3]
        apart = np.linalg.norm(centres[self.pairs[:, 0]] - centres[self.pairs[:, 1]], axis=1)
        best = int(np.argmax(share * np.sqrt(apart + 1e-9)))
        return int(self.pairs[best, 0]), int(self.pairs[best, 1])


def examine(scene: Scene) -> Examined | None:
    """Load what is compared; None where fewer than three frames have depth. Raises SceneError."""
    looks = load_looks(scene.frames)
    if len(looks) < 3:
        return None
    turn = np.eye(3) if scene.turn is None else scene.turn
    return Examined(scene, looks, Views(looks, turn), pairs_of(len(looks)), load_photos(scene.frames))


def listed_frames(frames: tuple[Frame, ...], numbers: list[int]) -> tuple[str, ...]:
    """The names of frames by their numbers."""
    return tuple(frames[number].name for number in numbers)
