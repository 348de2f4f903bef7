"""model.safetensors: a scene comes back as it was, and what is not known is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from engine.model.structured import NO_OBJECT, SPARE, GaussianLabels, StructuredScene, from_tensors, to_tensors
from tests.model.some_scene import GAUSSIANS, some_scene

SLOT_IDS, CLASS_OF_SLOT = (4, NO_OBJECT, 9, SPARE, SPARE), (7, 0, 5, 0, 0)


@pytest.fixture
def scene() -> StructuredScene:
    return some_scene(SLOT_IDS, class_of_slot=CLASS_OF_SLOT)


def stored(scene: StructuredScene, folder: Path) -> tuple[StructuredScene, dict[str, torch.Tensor]]:
    tensors, facts = to_tensors(scene)
    save_file(tensors, folder / "model.safetensors")
    return from_tensors(load_file(folder / "model.safetensors"), facts), tensors


@pytest.mark.parametrize("voted", [False, True])
def test_a_scene_comes_back_as_it_was(scene: StructuredScene, voted: bool, tmp_path: Path) -> None:
    if voted:
        label = torch.arange(GAUSSIANS * 2, dtype=torch.int16).reshape(GAUSSIANS, 2) % 5
        scene = replace(scene, voted=GaussianLabels(label, torch.rand(GAUSSIANS, 2)))
    back, tensors = stored(scene, tmp_path)
    again, _ = to_tensors(back)
    assert again.keys() == tensors.keys() and all(torch.equal(again[name], tensors[name]) for name in tensors)
    assert back.channels == scene.channels and back.voxel_size == scene.voxel_size
    assert (back.voted is not None) is voted


@pytest.mark.parametrize("number", [1, 3, None])
def test_other_formats_are_refused(scene: StructuredScene, number: int | None) -> None:
    tensors, facts = to_tensors(scene)
    with pytest.raises(ValueError, match=f"model format {number} is not known to this version; lift again or update"):
        from_tensors(tensors, facts | {"format": number})
