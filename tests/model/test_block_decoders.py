"""A scene of two blocks shows what its blocks show."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from engine.model.anchors import Anchors
from engine.model.block_decoders import BlockDecoders, BlockShape
from engine.model.decoders import Decoders
from engine.model.gaussians import decode, no_labels
from engine.model.structured import NO_OBJECT, GaussianLabels, StructuredScene, from_tensors, to_tensors
from tests.model.some_scene import CAMERA, SHAPE, some_scene

FIRST = 30
"""Anchors of the first block."""


@pytest.fixture
def blocks() -> tuple[StructuredScene, StructuredScene]:
    whole = some_scene((NO_OBJECT, 4), class_of_slot=(0, 7), shape=replace(SHAPE, instance_slots=2))
    rows = torch.arange(len(whole.anchors))
    first = replace(whole, anchors=whole.anchors.select(rows[:FIRST]))
    decoders = Decoders(whole.decoders.shape, seed=8)
    return first, replace(whole, anchors=whole.anchors.select(rows[FIRST:]), decoders=decoders)


def joined(blocks: tuple[StructuredScene, StructuredScene]) -> StructuredScene:
    parts = [block.anchors.tensors() for block in blocks]
    anchors = Anchors(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})
    shape = BlockShape(**vars(blocks[0].decoders.shape), anchors=tuple(len(block.anchors) for block in blocks))
    label = torch.zeros(len(anchors) * anchors.gaussians_per_anchor, 1)
    voted = GaussianLabels(label.to(torch.int16), label + 1)
    decoders = BlockDecoders.joined(shape, [block.decoders for block in blocks])
    return replace(blocks[0], anchors=anchors, decoders=decoders, voted=voted)


@torch.no_grad()
def test_each_block_is_decoded_by_its_own_decoders(blocks: tuple[StructuredScene, StructuredScene]) -> None:
    whole = joined(blocks)
    found = decode(whole.anchors, whole.decoders, CAMERA, known_labels=no_labels(whole.anchors))
    apart = [decode(one.anchors, one.decoders, CAMERA, known_labels=no_labels(one.anchors)) for one in blocks]
    for name in ("means", "scales", "quats", "opacities", "colours", "all_opacities"):
        assert torch.equal(getattr(found, name), torch.cat([getattr(one, name) for one in apart])), name
    k = whole.anchors.gaussians_per_anchor
    assert torch.equal(found.rows(k), torch.cat([apart[0].rows(k), apart[1].rows(k) + FIRST * k]))


def test_it_comes_back_from_its_file(blocks: tuple[StructuredScene, StructuredScene]) -> None:
    whole = joined(blocks)
    tensors, facts = to_tensors(whole)
    shape = facts["decoders"]
    assert isinstance(shape, dict)
    again = from_tensors(tensors, facts | {"decoders": shape | {"anchors": list(shape["anchors"])}})
    assert again.decoders.shape == whole.decoders.shape
    back, _ = to_tensors(again)
    assert back.keys() == tensors.keys() and all(torch.equal(back[name], tensors[name]) for name in tensors)


@pytest.mark.parametrize("counts", [[], [-1, 81], [1.5], "ab", [30, True], [1] * 1001])
def test_impossible_blocks_are_refused(blocks: tuple[StructuredScene, StructuredScene], counts: object) -> None:
    tensors, facts = to_tensors(joined(blocks))
    shape = facts["decoders"]
    assert isinstance(shape, dict)
    with pytest.raises(ValueError, match="block"):
        from_tensors(tensors, facts | {"decoders": shape | {"anchors": counts}})


def test_other_numbers_of_anchors_are_refused(blocks: tuple[StructuredScene, StructuredScene]) -> None:
    tensors, facts = to_tensors(joined(blocks))
    shape = facts["decoders"]
    assert isinstance(shape, dict)
    with pytest.raises(ValueError, match="blocks"):
        from_tensors(tensors, facts | {"decoders": shape | {"anchors": [30, 49]}})
