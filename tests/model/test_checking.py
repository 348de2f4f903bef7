"""model.safetensors: read back as it was, or refused before a kernel, which has no bounds of its own, sees it."""

import copy
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file, save, save_file

from engine.job import LiftFolder, LiftRequest
from engine.lift.scene_files import read_model, write_model
from engine.model.render import render_view
from engine.model.structured import NO_OBJECT, SPARE, GaussianLabels, StructuredScene, from_tensors, to_tensors
from tests.fuzzing import examples
from tests.model.some_scene import CAMERA, GAUSSIANS, some_scene
from tests.raises_key import raises_key

REFUSED = (ValueError, KeyError, TypeError, AttributeError)
ODD_VALUES = [None, True, -1, 0, 1, 2, 5, 64, 65536, 2**31, 2**63, 1e308, math.nan, "7", [], {}, [7], [[7]], [0, 1, 2]]
ODD_NUMBERS = [math.nan, math.inf, -math.inf, 1e38, -1e38, 3e6, 1e-40, 0.0, -1e6, -50, -1, 1, 3, 50, 1e6]
ODD_COUNTS = [-(2**40), -1_000_000, -50, -1, 0, 1, 3, 4, 5, 50, 64, 32767, 1_000_000, 2**40]


def a_model(voted: bool) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    scene = some_scene((4, NO_OBJECT, 9, SPARE, SPARE), class_of_slot=(7, 0, 5, 0, 0))
    if voted:
        label = torch.arange(GAUSSIANS * 2, dtype=torch.int16).reshape(GAUSSIANS, 2) % 5
        scene = replace(scene, voted=GaussianLabels(label, torch.full((GAUSSIANS, 2), 0.5)))
    return to_tensors(scene)


MODELS = {voted: a_model(voted) for voted in (False, True)}


def refused(tensors: dict[str, torch.Tensor], facts: dict[str, Any], match: str | None = None) -> None:
    with pytest.raises(REFUSED, match=match):
        from_tensors(tensors, facts)


def test_a_model_file_with_missing_rows_is_refused(tmp_path: Path) -> None:
    """The file that crashed the engine: a position for each of three million anchors, one scale."""
    tensors, facts = a_model(voted=False)
    vast = tensors | {"anchors.position": torch.zeros(3_000_000, 3), "anchors.log_scale": torch.zeros(1, 6)}
    refused(vast, facts, "anchors")
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    folder.result_path.mkdir()
    (folder.result_path / "model.safetensors").write_bytes(save(vast, metadata={"plgs": "{}"}))
    with raises_key("model-unreadable"):
        read_model(folder)


@pytest.mark.parametrize("name", [*a_model(voted=True)[0]])
def test_every_tensor_of_a_model_file_is_checked(name: str) -> None:
    tensors, facts = MODELS[True]
    right = tensors[name]
    refused({other: tensor for other, tensor in tensors.items() if other != name}, facts, name.split(".")[0])
    for wrong in (right[:-1], right[..., :-1], right.unsqueeze(0), right.double(), torch.tensor(1.0)):
        refused(tensors | {name: wrong}, facts)
    if right.dtype is torch.float32:
        for number in (math.nan, math.inf, -math.inf, 1e38):
            wrong = right.clone()
            wrong.view(-1)[3] = number
            refused(tensors | {name: wrong}, facts, "its range")
    refused(tensors | {"more": right}, facts, "more is not known")


def test_a_model_with_labels_outside_its_tables_is_refused() -> None:
    tensors, facts = MODELS[True]
    for number in (-1, 5, 32767):
        refused(tensors | {"voted.label": torch.full((GAUSSIANS, 2), number, dtype=torch.int16)}, facts, "its range")
    refused(tensors | {"anchors.initial_class": torch.full((80,), 2**40)}, facts, "its range")


@examples(40)
@given(data=st.data(), voted=st.booleans())
def test_a_spoilt_model_file_is_refused_or_can_be_drawn(data: st.DataObject, voted: bool) -> None:
    draw_spoilt(data.draw, voted)


def draw_spoilt(draw: Any, voted: bool) -> bool:
    """Spoil a model at some places and draw it, if it is taken; whether it was."""
    tensors, facts = dict(MODELS[voted][0]), copy.deepcopy(MODELS[voted][1])
    for _ in range(draw(st.integers(1, 3))):
        if draw(st.booleans()):
            holder = draw(st.sampled_from([facts, facts["decoders"]]))
            if isinstance(holder, dict) and holder:
                holder[draw(st.sampled_from(sorted(holder)))] = draw(st.sampled_from(ODD_VALUES))
        else:
            name = draw(st.sampled_from(sorted(tensors)))
            tensors[name] = spoilt(draw, tensors[name])
        if not isinstance(facts.get("decoders"), dict):
            break
    try:
        scene = from_tensors(tensors, facts)
    except REFUSED as error:
        assert "\n" not in str(error)
        return False
    draws(scene)
    return True


def spoilt(draw: Any, tensor: torch.Tensor) -> torch.Tensor:
    tensor = tensor.clone()
    match draw(st.sampled_from(["number", "numbers", "shape", "type"])):
        case "number" if tensor.numel():
            tensor.view(-1)[draw(st.integers(0, tensor.numel() - 1))] = draw(st.sampled_from(odd_numbers(tensor.dtype)))
        case "numbers":
            tensor.fill_(draw(st.sampled_from(odd_numbers(tensor.dtype))))
        case "shape":
            tensor = tensor[: draw(st.integers(0, len(tensor)))]
        case "type":
            tensor = tensor.to(draw(st.sampled_from([torch.float64, torch.int64, torch.int16, torch.uint8])))
    return tensor


def odd_numbers(dtype: torch.dtype) -> list[float]:
    """Those that a tensor of this type can hold: torch puts no other into one."""
    if dtype.is_floating_point:
        return ODD_NUMBERS
    bounds = torch.iinfo(dtype)
    return [number for number in ODD_COUNTS if bounds.min <= number <= bounds.max]


def draws(scene: StructuredScene) -> None:
    rendering = render_view(scene, CAMERA)
    assert rendering.image.shape == (CAMERA.height, CAMERA.width, 3)


def test_a_model_with_bad_metadata_gives_a_one_line_error(tmp_path: Path) -> None:
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    folder.result_path.mkdir()
    path = folder.result_path / "model.safetensors"
    tensors, _ = MODELS[False]
    for notes in ({}, {"plgs": "["}, {"plgs": "[]"}, {"plgs": "[" * 100_000}, {"plgs": "7"}, {"plgs": '{"format": 2}'}):
        path.write_bytes(save(tensors, metadata=notes))
        with raises_key("model-unreadable"):
            read_model(folder)
    write_model(folder, from_tensors(*MODELS[True]))
    draws(read_model(folder))
    whole = path.read_bytes()
    for content in (b"", whole[:7], whole[:200], whole[:-5], b"\xff" * 8 + whole[8:]):
        path.write_bytes(content)
        with raises_key("model-unreadable"):
            read_model(folder)
    path.unlink()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        with raises_key("model-unreadable"):
            read_model(folder)


@pytest.mark.slow
def test_models_that_pass_the_checks_stay_within_kernel_limits(root: Path, tmp_path: Path) -> None:
    """The fuzz above once more, in a process whose kernels raise IndexError where they would read or write astray."""
    variables = os.environ | {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path), "PLGS_FUZZ": "10"}
    fuzz = f"{__file__}::{test_a_spoilt_model_file_is_refused_or_can_be_drawn.__name__}"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", fuzz]
    said = subprocess.run(command, cwd=root, env=variables, capture_output=True, text=True, timeout=1800)
    assert said.returncode == 0, said.stdout


SLOT_IDS, CLASS_OF_SLOT = (4, NO_OBJECT, 9, SPARE, SPARE), (7, 0, 5, 0, 0)


@pytest.fixture
def scene() -> StructuredScene:
    return some_scene(SLOT_IDS, class_of_slot=CLASS_OF_SLOT)


def stored(scene: StructuredScene, folder: Path) -> tuple[StructuredScene, dict[str, torch.Tensor]]:
    tensors, facts = to_tensors(scene)
    save_file(tensors, folder / "model.safetensors")
    return from_tensors(load_file(folder / "model.safetensors"), facts), tensors


@pytest.mark.parametrize("voted", [False, True])
def test_a_model_file_is_read_back_as_it_was_written(scene: StructuredScene, voted: bool, tmp_path: Path) -> None:
    if voted:
        label = torch.arange(GAUSSIANS * 2, dtype=torch.int16).reshape(GAUSSIANS, 2) % 5
        scene = replace(scene, voted=GaussianLabels(label, torch.rand(GAUSSIANS, 2)))
    back, tensors = stored(scene, tmp_path)
    again, _ = to_tensors(back)
    assert again.keys() == tensors.keys() and all(torch.equal(again[name], tensors[name]) for name in tensors)
    assert back.channels == scene.channels and back.voxel_size == scene.voxel_size
    assert (back.voted is not None) is voted


@pytest.mark.parametrize("number", [1, 3, None])
def test_model_files_of_other_format_versions_are_refused(scene: StructuredScene, number: int | None) -> None:
    tensors, facts = to_tensors(scene)
    with pytest.raises(ValueError, match=f"model format {number} is not known to this version; lift again or update"):
        from_tensors(tensors, facts | {"format": number})
