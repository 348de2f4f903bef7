from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.scene import Scene, check_scene, open_scene, open_scene_to_lift
from engine.scene_source import SceneSource
from tests.scene.refusing import refuses
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene", frames=6, size=(32, 24), masks="panoptic_lifting")


def paint(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), pixels)


def classes_seen(scene: Scene) -> np.ndarray:
    return scene.frames[1].read_mask(None).class_map()


def test_the_reduced_table_is_the_papers(folder: Path) -> None:
    classes = open_scene(folder).classes
    assert len(classes) == 21 and classes[21].name == "otherprop"
    assert {classes[i].name for i in classes.thing_ids} == {
        *("bed chair sofa refrigerator television person toilet sink bag".split())
    }
    assert not classes[7].is_thing and classes[19].name == "lamp"


def test_segments_are_the_pairs_that_occur(folder: Path) -> None:
    frame = open_scene(folder).frames[1]
    mask = frame.read_mask(None)
    truth = cv2.imread(str(folder / "gt" / "semantic" / "0001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask.class_map(), truth)
    assert [segment.id for segment in mask.segments] == list(range(1, len(mask.segments) + 1))
    assert {s.class_id: s.is_thing for s in mask.segments} == {1: False, 2: False, 3: False, 5: True}
    assert not any(segment.is_group for segment in mask.segments), "stuff is no group of things"
    assert mask.ids.min() > 0 and check_scene(open_scene(folder)) == ()


@pytest.mark.parametrize("pixel_type", [np.uint8, np.uint16])
def test_two_chairs_are_two_segments_at_any_bit_depth(folder: Path, pixel_type: type) -> None:
    semantic, instance = np.full((24, 32), 5, pixel_type), np.zeros((24, 32), pixel_type)
    semantic[:4] = 0
    instance[4:, :10], instance[4:, 10:20] = 200, 201
    paint(folder / "m2f_semantics" / "0001.png", semantic)
    paint(folder / "m2f_instance" / "0001.png", instance)
    mask = open_scene(folder).frames[1].read_mask(None)
    assert not mask.ids[:4].any()
    found = [(s.class_id, s.is_thing, s.is_group) for s in mask.segments]
    assert found == [(5, False, True), (5, True, False), (5, True, False)], "instance 0 may be several chairs"
    assert (mask.ids[5, 25], mask.ids[5, 0], mask.ids[5, 15]) == (1, 2, 3)


def test_the_set_without_augmentation_is_used_if_it_is_the_only_one_or_named(folder: Path) -> None:
    for kind in ("semantics", "instance"):
        (folder / f"m2f_{kind}").rename(folder / f"m2f_notta_{kind}")
    assert set(classes_seen(open_scene(folder)).ravel()) >= {1, 2}
    for index in range(6):
        paint(folder / "m2f_semantics" / f"{index:04d}.png", np.full((24, 32), 4, np.uint8))
        paint(folder / "m2f_instance" / f"{index:04d}.png", np.ones((24, 32), np.uint8))
    both = open_scene(folder)
    assert (classes_seen(both) == 4).all() and "name m2f_notta_semantics" in both.warnings[0]
    named = open_scene(folder, masks=folder / "m2f_notta_semantics")
    assert (classes_seen(named) != 4).all() and named.warnings == ()


def test_masks_may_lie_elsewhere(folder: Path, tmp_path: Path) -> None:
    for kind in ("semantics", "instance"):
        (tmp_path / "masks").mkdir(exist_ok=True)
        (folder / f"m2f_{kind}").rename(tmp_path / "masks" / f"m2f_{kind}")
    with pytest.raises(PlgsError, match="no masks"):
        open_scene_to_lift(SceneSource(folder))
    assert len(open_scene(folder, masks=tmp_path / "masks").frames) == 6
    refuses("no masks", folder, masks=tmp_path / "nowhere")


def test_coco_masks_may_be_named_by_file_or_folder(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    (tmp_path / "masks").mkdir()
    (scene / "panoptic").rename(tmp_path / "masks" / "detector")
    (scene / "panoptic.json").rename(tmp_path / "masks" / "detector.json")
    assert len(open_scene(scene, masks=tmp_path / "masks" / "detector.json").frames) == 5
    (tmp_path / "masks" / "detector").rename(tmp_path / "masks" / "panoptic")
    (tmp_path / "masks" / "detector.json").rename(tmp_path / "masks" / "panoptic.json")
    assert len(open_scene(scene, masks=tmp_path / "masks").frames) == 5
