"""Records of a mask and of an object. Each stage of a lift fills in what it finds out about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..scene import Segment
from .oriented_box import OrientedBox


@dataclass(frozen=True)
class ObjectMask:
    """One mask of one view: the ``segment`` of a ``frame``.

    ``pixels``: the number of pixels with depth, 0 until they are counted. ``cost``: O of the match by boxes, None for
    the mask that founded the object. ``agreement``: views judge a mask together with every other mask of its object;
    this is the share of these judgements that show both inside one mask, None if there are none.
    """

    frame: str
    segment: Segment
    pixels: int = 0
    cost: float | None = None
    agreement: float | None = None

    @property
    def key(self) -> tuple[str, int]:
        """What identifies the mask: its frame, and the id of its segment."""
        return self.frame, self.segment.id


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object: its ``id`` from 1, its ``masks``, its class (0 until it is known), its ``points`` float64 [n, 3] in
    metres and the ``box`` around them (of size zero while it has no points)."""

    id: int
    masks: tuple[ObjectMask, ...]
    class_id: int = 0
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    box: OrientedBox = field(default_factory=lambda: OrientedBox(np.zeros(3), np.zeros(3), 0.0))

    @property
    def views(self) -> int:
        return len({mask.frame for mask in self.masks})

    @property
    def score(self) -> float:
        """The mean score of the masks."""
        return sum(mask.segment.score for mask in self.masks) / len(self.masks)

    @property
    def pixels(self) -> int:
        return sum(mask.pixels for mask in self.masks)


def object_of_mask(objects: Sequence[SceneObject]) -> dict[tuple[str, int], int]:
    """The id of the object that each mask belongs to, by frame and segment id."""
    return {mask.key: one.id for one in objects for mask in one.masks}
