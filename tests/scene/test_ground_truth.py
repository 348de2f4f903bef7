from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import Scene, check_scene, load_view, open_scene
from tests.scene.refusing import refuses
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path, frames=5, size=(32, 24))


def semantic(scene: Scene, position: int = 1) -> np.ndarray:
    reader = scene.frames[position].read_ground_truth
    assert reader is not None
    truth = reader(None)
    assert truth is not None
    return truth.semantic


def test_classes_and_instances_are_read_at_any_size(folder: Path) -> None:
    reader = open_scene(folder).frames[1].read_ground_truth
    assert reader is not None
    own, small = reader(None), reader((16, 12))
    assert own is not None and small is not None
    assert own.semantic.dtype == own.instance.dtype == np.int32
    assert {*np.unique(own.instance).tolist()} == {0, 1, 2}
    assert (own.semantic[own.instance == 1] == 5).all() and (own.semantic[own.instance == 2] == 3).all()
    np.testing.assert_array_equal(small.semantic, own.semantic[1::2, 1::2])


def test_panoptic_liftings_folders_come_first(folder: Path) -> None:
    for index in range(5):
        for kind in ("semantics", "instance"):
            (folder / f"rs_{kind}").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / f"rs_{kind}" / f"{index:04d}.png"), np.full((24, 32), 2, np.uint8))
    scene = open_scene(folder)
    assert (semantic(scene) == 2).all()
    assert any("rs_semantics is in Panoptic Lifting's class table" in warning for warning in scene.warnings)


def test_a_semantic_folder_may_name_its_table(folder: Path) -> None:
    (folder / "gt" / "semantic").rename(folder / "gt" / "semantic_nyu40")
    assert semantic(open_scene(folder)).any()


def test_unknown_classes_become_void_with_a_warning(folder: Path) -> None:
    cv2.imwrite(str(folder / "gt" / "semantic" / "0001.png"), np.full((24, 32), 99, np.uint8))
    scene = open_scene(folder)
    assert not semantic(scene).any()
    assert check_scene(scene)[-1] == "class ids 99 of the ground truth are not in the masks' table and count as void"


def test_frames_may_lack_ground_truth(folder: Path) -> None:
    (folder / "gt" / "instance" / "0001.png").unlink()
    scene = open_scene(folder)
    assert scene.frames[1].read_ground_truth is None and scene.frames[0].read_ground_truth is not None
    assert scene.warnings == ("1 of 5 frames have no ground truth in semantic",)
    shutil.rmtree(folder / "gt")
    scene = open_scene(folder)
    assert not any(frame.read_ground_truth for frame in scene.frames) and scene.warnings == ()


def test_views_do_not_depend_on_ground_truth(folder: Path) -> None:
    before = [load_view(frame) for frame in open_scene(folder).frames]
    shutil.rmtree(folder / "gt")
    for one, frame in zip(before, open_scene(folder).frames, strict=True):
        other = load_view(frame)
        assert one.mask.segments == other.mask.segments
        for a, b in ((one.colour, other.colour), (one.depth, other.depth), (one.mask.ids, other.mask.ids)):
            np.testing.assert_array_equal(a, b)


def test_damaged_ground_truth_is_found_by_the_checks(folder: Path) -> None:
    path = folder / "gt" / "instance" / "0001.png"
    data = bytearray(path.read_bytes())
    data[-30] ^= 0xFF
    path.write_bytes(bytes(data))
    refuses("damaged", folder, look_into_pixels=True)
