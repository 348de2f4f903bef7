"""Segments out of pictures: of the pairs of class and instance, and of masks that lie on top of each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .source import FoundMask, FoundSegment


def segments_of_pairs(labels: NDArray[np.integer], instances: NDArray[np.integer], tracked: bool = False) -> FoundMask:
    """Every pair that occurs of a class in ``labels`` [H, W] (below 0 = void) and an instance in ``instances`` [H, W]
    (0 or below = none) is a segment, numbered from 1; those of the class 0, which is void in most tables, come last.
    ``tracked``: instances are the same in all frames."""
    pairs = labels.astype(np.int64) << 32 | np.maximum(instances, 0).astype(np.int64)
    present, inverse = np.unique(pairs, return_inverse=True)
    number = np.zeros(len(present), np.int32)
    segments: list[FoundSegment] = []
    for place in sorted(np.flatnonzero(present >= 0).tolist(), key=lambda place: (present[place] >> 32 == 0, place)):
        label, instance = int(present[place]) >> 32, int(present[place]) & 0xFFFFFFFF
        number[place] = len(segments) + 1
        track = instance if tracked and instance else None
        segments.append(FoundSegment(len(segments) + 1, label, has_instance=instance != 0, track=track))
    return FoundMask(number[inverse.reshape(pairs.shape)], tuple(segments))


def segments_of_labels(labels: NDArray[np.integer]) -> FoundMask:
    """Every class in ``labels`` [H, W] (below 0 = void) is one segment, which may be several objects."""
    return segments_of_pairs(labels, np.zeros_like(labels))


def paint(masks: Sequence[NDArray[np.bool_]], segments: Sequence[FoundSegment]) -> NDArray[np.int32]:
    """Ids, int32 [H, W], of ``masks`` bool [H, W] each, one a segment: where they overlap, the one with the highest
    score is on top, of equals the smaller."""
    ids = np.zeros(masks[0].shape, np.int32)
    sizes = [int(mask.sum()) for mask in masks]
    for place in sorted(range(len(masks)), key=lambda place: (segments[place].score, -sizes[place])):
        ids[masks[place]] = segments[place].id
    return ids
