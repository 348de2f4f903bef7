"""Mask2Former itself, with random weights: transformers' own loading, no download."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from engine.command_line.main import main
from engine.scene import check_scene, open_scene
from tests.commands import exit_code
from tests.tiny_scene import write_tiny_scene

pytest.importorskip("transformers", reason="needs transformers (requirements/segment.txt)")

from engine.segment import load_model  # noqa: E402
from tests.raises_key import raises_key
from tests.segment.tiny_mask2former import NAMES, save_tiny_mask2former  # noqa: E402


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_mask2former(tmp_path_factory.mktemp("mask2former"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = write_tiny_scene(tmp_path / "scene", frames=3, size=(64, 48), ground_truth=False)
    shutil.rmtree(folder / "panoptic")
    (folder / "panoptic.json").unlink()
    return folder


def test_a_model_in_a_folder(model: Path) -> None:
    network = load_model(str(model), download=False)
    assert [label.name for label in network.labels] == NAMES
    assert [label.is_thing for label in network.labels] == [False, False, True, True]
    colour = np.random.default_rng(0).integers(0, 255, (48, 80, 3), np.uint8)
    ids, found = network.segment(colour)
    assert ids.shape == (48, 80) and {*np.unique(ids).tolist()} - {0} == {one.id for one in found} != set()
    again, _ = network.segment(colour)
    np.testing.assert_array_equal(ids, again)


def test_large_pictures_have_smaller_masks_of_the_same_shape(model: Path) -> None:
    ids, _ = load_model(str(model), download=False).segment(np.zeros((1000, 2000, 3), np.uint8))
    assert ids.shape == (640, 1280)


def test_the_command_makes_masks_that_open(model: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(main, "segment", folder, "--model", model) == 0
    told = capsys.readouterr()
    assert "3/3" in told.err and told.out == f"Masks of 3 frames: {folder}\n"
    scene = open_scene(folder)
    check_scene(scene)
    assert [one.name for one in scene.classes.categories] == NAMES
    assert any(frame.mask().segments for frame in scene.frames)
    assert exit_code(main, "segment", folder, "--model", model) == 0
    assert "finished already" in capsys.readouterr().out


def test_nothing_is_downloaded_without_consent() -> None:
    with raises_key("not-downloaded nobody/no-such-model --download"):
        load_model("nobody/no-such-model", download=False)


@pytest.mark.parametrize(("name", "told"), [("nowhere", "no-model"), ("tests", "no-model")])
def test_a_missing_model_is_a_one_line_error(name: str, told: str) -> None:
    with raises_key(told):
        load_model(name, download=False)


def test_pickled_weights_are_not_read(model: Path, tmp_path: Path) -> None:
    shutil.copytree(model, tmp_path / "pickled")
    (tmp_path / "pickled" / "model.safetensors").rename(tmp_path / "pickled" / "pytorch_model.bin")
    with raises_key("no-model"):
        load_model(str(tmp_path / "pickled"), download=False)


def test_a_broken_model_is_a_one_line_error(model: Path, tmp_path: Path) -> None:
    shutil.copytree(model, tmp_path / "broken")
    (tmp_path / "broken" / "model.safetensors").write_bytes(b"\0" * 40)
    with raises_key("model-unusable"):
        load_model(str(tmp_path / "broken"), download=False)
