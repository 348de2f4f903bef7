"""What transformers' post_process_panoptic_segmentation and detectron2's panoptic models give, saved by their users."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from engine.scene.class_tables import known_table
from tests.scene.mask_formats.labelled_room import COCO_NAMES, COCO_NUMBERS, Truth, check_on_room, mask_of, write_frames
from tests.scene.refusing import check_scene, refuses

CONFIG = {"id2label": {str(COCO_NUMBERS[one]): COCO_NAMES[one] for one in COCO_NUMBERS}}
CHAIRS = frozenset({"chair"})


def transformers_result(truth: Truth, first: int = 1, void: int = 0) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Segments in no order, ids from ``first``; the upper half of the wall is a segment of its own, as a query each is
    without fusing."""
    picture = np.full(truth.semantic.shape, void, np.int32)
    infos = []
    for class_id, _, region in truth.regions():
        halves = [region]
        if class_id == 1:
            rows = np.arange(region.shape[0])[:, None] < 6
            halves = [half for half in (region & rows, region & ~rows) if half.any()]
        for half in halves:
            number = first + len(infos)
            picture[half] = number
            label = COCO_NUMBERS[class_id]
            infos.append({"id": number, "label_id": label, "was_fused": False, "score": 0.75})
    return picture, infos


def save(folder: Path, name: str, picture: np.ndarray, infos: Any) -> None:
    folder.mkdir(exist_ok=True)
    np.save(folder / f"{name}.npy", picture)
    (folder / f"{name}.json").write_text(json.dumps(infos))


def write_transformers(folder: Path, first: int = 1, void: int = 0) -> list[Truth]:
    scene, truths = write_frames(folder)
    for truth in truths:
        picture, infos = transformers_result(truth, first, void)
        save(scene / "masks", truth.name, picture, {"segments_info": infos})
    (scene / "masks" / "config.json").write_text(json.dumps(CONFIG))
    return truths


def test_segment_maps_of_transformers_use_the_models_class_names(tmp_path: Path) -> None:
    truths = write_transformers(tmp_path)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, COCO_NAMES, CHAIRS)
    assert {one.score for one in mask_of(scene).segments} == {0.75}
    walls = [one for one in mask_of(scene).segments if scene.classes[one.class_id].name == "wall-other-merged"]
    assert len(walls) == 1, "stuff in pieces is one segment"


@pytest.mark.parametrize(("table", "is_thing"), [("coco", True), ("cityscapes", False)])
def test_things_come_from_the_table_with_the_models_class_names(tmp_path: Path, table: str, is_thing: bool) -> None:
    """A traffic light is a thing in COCO and stuff in Cityscapes; nothing in transformers' results says so."""
    scene, (truth, *_) = write_frames(tmp_path)
    labels = {label.name: label.id for label in known_table(table).labels}
    config = {"id2label": {str(number): name for name, number in labels.items()}}
    info = {"id": 1, "label_id": labels["traffic light"], "was_fused": False, "score": 0.5}
    for path in sorted((scene / "color").iterdir()):
        save(scene / "masks", path.stem, np.ones(truth.semantic.shape, np.int32), {"segments_info": [info]})
    (scene / "masks" / "config.json").write_text(json.dumps(config))
    assert [segment.is_thing for segment in mask_of(open_scene(scene)).segments] == [is_thing]


def test_a_picture_in_which_transformers_found_nothing_is_void(tmp_path: Path) -> None:
    write_transformers(tmp_path)
    save(tmp_path / "masks", "0001", np.full((48, 64), -1.0, np.float32), [])
    scene = open_scene(tmp_path)
    assert not mask_of(scene, 1).ids.any() and mask_of(scene, 1).segments == ()
    assert any("empty mask" in warning for warning in check_scene(scene))


def test_pngs_of_transformers_are_read_with_a_named_class_table(tmp_path: Path) -> None:
    truths = write_transformers(tmp_path, first=0, void=-1)
    (tmp_path / "masks" / "config.json").unlink()
    for path in sorted((tmp_path / "masks").glob("*.npy")):
        picture = np.load(path)
        picture[:2] = -1
        cv2.imwrite(str(path.with_suffix(".png")), picture.astype(np.uint8))
        path.unlink()
    for truth in truths:
        truth.semantic[:2] = 0
        truth.instance[:2] = 0
    check_on_room(open_scene(tmp_path, classes="coco"), truths, COCO_NAMES | {0: ""}, CHAIRS)
    refuses("no-class-names --classes", tmp_path)


def write_detectron2(folder: Path, numbers: dict[int, int], things: set[int]) -> list[Truth]:
    scene, truths = write_frames(folder)
    for truth in truths:
        picture = np.full(truth.semantic.shape, -1, np.int64)
        infos = []
        for number, (class_id, _, region) in enumerate(truth.regions(), start=1):
            picture[region] = number
            infos.append({"id": number, "isthing": class_id in things, "category_id": numbers[class_id]})
        picture[:3, :3] = -1
        save(scene / "masks", truth.name, picture, infos)
        truth.semantic[:3, :3], truth.instance[:3, :3] = 0, 0
    return truths


@pytest.mark.parametrize("is_apart", [False, True])
def test_both_class_numberings_of_detectron2_are_read(tmp_path: Path, is_apart: bool) -> None:
    stuff_apart = {class_id: number - 79 for class_id, number in COCO_NUMBERS.items() if class_id != 5}
    numbers = COCO_NUMBERS | stuff_apart if is_apart else COCO_NUMBERS
    if is_apart:  # stuff 41 is a cabinet, thing 41 is a cup: here the chair is one
        numbers = numbers | {5: 41}
    truths = write_detectron2(tmp_path, numbers, {5})
    names = COCO_NAMES | {0: ""} | ({5: "cup"} if is_apart else {})
    scene = open_scene(tmp_path, classes="coco")
    check_on_room(scene, truths, names, frozenset({names[5]}))
    assert check_scene(open_scene(tmp_path)) == ()
    assert any("--classes coco" in warning for warning in open_scene(tmp_path).warnings)


def test_masks_of_detectron2_need_a_class_table(tmp_path: Path) -> None:
    truths = write_detectron2(tmp_path, COCO_NUMBERS, {5})
    names = {one: f"class {number}" for one, number in COCO_NUMBERS.items()} | {0: ""}
    check_on_room(open_scene(tmp_path), truths, names, frozenset({"class 56"}))
