"""What a mask format's reader delivers: segments as the files number them, before their classes mean anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..classes import ClassLabel
from ..frame import Size


@dataclass(frozen=True)
class FoundSegment:
    """A region: its value ``id`` >= 1 in the pixels, its class ``label`` in the masks' own numbers, its score in 0..1.

    ``has_instance`` False: all that the frame shows of a class, which may be several objects. ``track``: see Segment.
    """

    id: int
    label: int
    score: float = 1.0
    has_instance: bool = True
    track: int | None = None


@dataclass(frozen=True, eq=False)
class FoundMask:
    """Segment ids, int32 [H, W] with 0 = void, and the segments."""

    ids: NDArray[np.int32]
    segments: tuple[FoundSegment, ...]


@dataclass(frozen=True)
class MaskSource:
    """All frames' masks. ``labels`` are the classes as far as the files tell, None where they do not.

    ``stuff_in_pieces``: one stuff class may come as several segments of a frame. ``tells_no_class``: the labels number
    objects; without a table these are all of the one class "object". ``void``: labels that mean nothing where the table
    does not have them. ``table`` names the classes' table in messages.
    """

    labels: tuple[ClassLabel, ...] | None
    readers: Mapping[str, Callable[[], FoundMask]]
    sizes: Mapping[str, Size]
    paths: Mapping[str, Path]
    warnings: tuple[str, ...] = ()
    stuff_in_pieces: bool = False
    tells_no_class: bool = False
    void: frozenset[int] = frozenset({0})
    table: str = "the class table"


IGNORED = frozenset({0, 255, 65535})
"""The labels that mean nothing in most label images, unless their table has them."""
