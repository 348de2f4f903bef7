"""Labels as channels and slots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from engine.model.structured import NO_OBJECT, SPARE, LabelChannels
from engine.train.targets import view_targets
from tests.semantics.plane_views import CHAIR, CLASS_IDS, WALL, square, wall_view

CHANNELS = LabelChannels(CLASS_IDS, (7, SPARE, NO_OBJECT, 3))


def test_stuff_is_taught_to_be_no_object_and_the_unknown_nothing() -> None:
    view = wall_view("a", 0.0, classes=square(CHAIR, WALL, slice(10, 20)).astype(np.int32))
    projected, matched = view.mask.ids.copy(), np.where(view.mask.ids == CHAIR, 7, 0).astype(np.int32)
    projected[:2] = 0
    border = np.zeros(view.mask.ids.shape, bool)
    border[0] = True
    target = view_targets(
        replace(view, border=border), CHANNELS, projected_class=projected, matched_instance=matched, weight=0.25
    )
    assert (target.slot[:2] == -1).all() and (target.semantic[:2] == -1).all()
    expected = square(CHANNELS.slot_ids.index(7), CHANNELS.slot_ids.index(NO_OBJECT), slice(10, 20))
    np.testing.assert_array_equal(target.slot[2:], expected[2:])
    assert target.weight == 0.25 and target.border is not None and torch.equal(target.border, torch.from_numpy(border))
    np.testing.assert_array_equal(target.depth, np.where(border, 0, view.depth))  # a border shows nothing
    target.pseudo, target.pseudo_slot = torch.zeros_like(target.projected), torch.ones_like(target.matched)
    assert target.semantic is target.pseudo and target.slot is target.pseudo_slot
