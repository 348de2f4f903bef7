"""From a network's queries to one panoptic mask, at the picture's own size (Mask2Former's panoptic inference).

transformers' own post-processing works at 384x384 for pictures of any shape and does not fuse stuff by default. Asked
to fuse, it gives one id to several segments.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

LEAST_SCORE = 0.5
"""The least score of a query that is a segment."""
INSIDE = 0.5
"""The least probability of a pixel of a query's mask."""
VISIBLE = 0.8
"""Share of a segment that the others must leave visible; else it is dropped."""


@dataclass(frozen=True)
class MadeSegment:
    """Its value ``id`` in the mask, the network's ``label``, and its score in [0, 1]."""

    id: int
    label: int
    score: float


def merge_queries(
    class_logits: torch.Tensor, mask_probabilities: torch.Tensor, stuff: Set[int]
) -> tuple[NDArray[np.int32], list[MadeSegment]]:
    """Segment ids, int32 [H, W] with 0 = none, and the segments.

    ``class_logits`` is float [Q, C + 1], with no object as the last class, ``mask_probabilities`` float [Q, H, W]. A
    pixel goes to the query with the greatest score times probability. ``stuff`` are labels with one segment per
    picture; its score is the mean of its queries', weighted by pixels.
    """
    ids = np.zeros(mask_probabilities.shape[1:], np.int32)
    scores, labels = class_logits.softmax(-1).max(-1)
    kept = (labels < class_logits.shape[-1] - 1) & (scores > LEAST_SCORE)
    if not bool(kept.any()):
        return ids, []
    masks = mask_probabilities[kept]
    owner = (masks * scores[kept, None, None]).argmax(0)
    found: dict[int, list[tuple[float, int]]] = {}
    label_of: dict[int, int] = {}
    stuff_id: dict[int, int] = {}
    for query, (label, score) in enumerate(zip(labels[kept].tolist(), scores[kept].tolist(), strict=True)):
        inside = masks[query] >= INSIDE
        region = (inside & (owner == query)).numpy()
        pixels = int(region.sum())
        if pixels == 0 or pixels < VISIBLE * int(inside.sum()):
            continue
        number = len(found) + 1
        if label in stuff:
            number = stuff_id.setdefault(label, number)
        label_of[number] = label
        found.setdefault(number, []).append((score, pixels))
        ids[region] = number
    return ids, [MadeSegment(number, label_of[number], _mean(parts)) for number, parts in found.items()]


def _mean(parts: list[tuple[float, int]]) -> float:
    """The mean score, weighted by pixels."""
    return sum(score * pixels for score, pixels in parts) / sum(pixels for _, pixels in parts)
