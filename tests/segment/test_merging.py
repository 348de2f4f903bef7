from __future__ import annotations

import numpy as np
import torch

from engine.segment import MadeSegment, merge_queries

STUFF = frozenset({0})
"""Label 0 is a wall, 1 a chair; 2 stands for no object."""


def logits(*shares: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(shares).log()


def strips(*parts: slice) -> torch.Tensor:
    """A mask a query, 4x10 pixels, sure of these columns."""
    masks = torch.full((len(parts), 4, 10), 0.01)
    for mask, part in zip(masks, parts, strict=True):
        mask[:, part] = 0.99
    return masks


def test_stuff_is_fused_and_things_are_not() -> None:
    shares = [(0.8, 0.1, 0.1), (0.1, 0.9, 0.0001), (0.6, 0.2, 0.2), (0.1, 0.7, 0.2)]
    ids, found = merge_queries(logits(*shares), strips(slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)), STUFF)
    assert ids.dtype == np.int32 and ids[0].tolist() == [1, 1, 2, 2, 1, 1, 3, 3, 0, 0]
    assert [(one.id, one.label) for one in found] == [(1, 0), (2, 1), (3, 1)]
    np.testing.assert_allclose([one.score for one in found], [0.7, 0.9 / 1.0001, 0.7], rtol=1e-5)


def test_what_others_hide_is_dropped() -> None:
    """Of the second chair only 2 of 4 columns are its own: too little."""
    ids, found = merge_queries(logits((0.1, 0.8, 0.1), (0.1, 0.7, 0.2)), strips(slice(0, 4), slice(2, 6)), STUFF)
    assert ids[0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0, 0, 0] and len(found) == 1


def test_empty_and_uncertain_queries_are_not_segments() -> None:
    ids, found = merge_queries(logits((0.1, 0.1, 0.8), (0.4, 0.35, 0.25)), strips(slice(0, 4), slice(4, 9)), STUFF)
    assert not ids.any() and found == []


def test_a_segment_keeps_its_score() -> None:
    _, found = merge_queries(logits((0.2, 0.8, 1e-9)), strips(slice(0, 3)), STUFF)
    assert found == [MadeSegment(1, 1, found[0].score)] and abs(found[0].score - 0.8) < 1e-6
