import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.posed.classes import PALETTE
from engine.scene import open_scene
from tests.scene.refusing import check_scene
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path, frames=3, size=(32, 24))


def change(folder: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((folder / "panoptic.json").read_text())
    edit(content)
    (folder / "panoptic.json").write_text(json.dumps(content))


def test_coco_panoptic_masks_are_read_back_as_written(folder: Path) -> None:
    content = json.loads((folder / "panoptic.json").read_text())
    scene = open_scene(folder)
    for frame, annotation in zip(scene.frames, content["annotations"], strict=True):
        mask = frame.read_mask(None)
        truth = cv2.imread(str(folder / "gt" / "semantic" / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask.class_map(), truth)
        assert mask.ids.dtype == np.int32
        assert [(s.id, s.class_id, s.score) for s in mask.segments] == [
            (s["id"], s["category_id"], s["score"]) for s in annotation["segments_info"]
        ]
        for segment in annotation["segments_info"]:
            assert (mask.ids == segment["id"]).sum() == segment["area"]


def test_naming_the_folder_of_coco_pngs_finds_the_json_beside_it(folder: Path) -> None:
    named, found = open_scene(folder, masks=folder / "panoptic"), open_scene(folder)
    assert named.classes == found.classes
    np.testing.assert_array_equal(named.frames[0].mask((64, 48)).ids, found.frames[0].mask((64, 48)).ids)


def test_coco_mask_ids_use_all_three_colour_channels(folder: Path) -> None:
    red_green_blue = (7, 8, 9)
    pixels = np.zeros((24, 32, 3), np.uint8)
    pixels[4:, :] = red_green_blue[::-1]
    cv2.imwrite(str(folder / "panoptic" / "0001.png"), pixels)
    segment_id = 7 + 256 * 8 + 65536 * 9
    change(folder, lambda c: c["annotations"][1].update(segments_info=[{"id": segment_id, "category_id": 5}]))
    mask = open_scene(folder).frames[1].read_mask(None)
    assert mask.ids[0, 0] == 0 and mask.ids[10, 10] == segment_id
    assert mask.segments[0].score == 1.0, "a missing score is full trust"
    assert mask.class_map()[10, 10] == 5


def test_coco_masks_bring_their_own_class_table(folder: Path) -> None:
    change(folder, lambda c: c["categories"][0].pop("color"))
    change(folder, lambda c: c["categories"][1].update(isthing=True))
    classes = open_scene(folder).classes
    assert classes.ids == (1, 2, 3, 5, 13) and classes.thing_ids == {2, 3, 5}
    assert classes[5].name == "chair" and classes[5].colour == (210, 70, 60)
    assert classes[1].colour == PALETTE[24], "that of walls"


def test_coco_categories_that_start_at_0_are_shifted_by_one(folder: Path) -> None:
    def shift(content: dict[str, Any]) -> None:
        for entry in content["categories"]:
            entry["id"] -= 1
        for annotation in content["annotations"]:
            for segment in annotation["segments_info"]:
                segment["category_id"] -= 1

    before = open_scene(folder)
    change(folder, shift)
    after = open_scene(folder)
    assert after.classes == before.classes
    assert after.frames[0].read_mask(None).segments == before.frames[0].read_mask(None).segments


def test_resized_masks_keep_unblended_ids(folder: Path) -> None:
    frame = open_scene(folder).frames[0]
    own, large, small = frame.read_mask(None), frame.read_mask((64, 48)), frame.read_mask((16, 12))
    np.testing.assert_array_equal(large.ids, np.kron(own.ids, np.ones((2, 2), np.int32)))
    np.testing.assert_array_equal(small.ids, own.ids[1::2, 1::2])
    assert large.segments == own.segments == small.segments


def test_coco_crowds_become_void_with_a_warning(folder: Path) -> None:
    change(folder, lambda c: c["annotations"][1]["segments_info"][0].update(iscrowd=1))
    scene = open_scene(folder)
    crowd = json.loads((folder / "panoptic.json").read_text())["annotations"][1]["segments_info"][0]
    mask = scene.frames[1].read_mask(None)
    assert crowd["id"] not in mask.ids and crowd["id"] not in [segment.id for segment in mask.segments]
    assert (mask.ids == 0).sum() == crowd["area"]
    assert "crowd segments (iscrowd) count as void: 0001" in scene.warnings


def test_coco_masks_with_label_ids_of_transformers_are_read(folder: Path) -> None:
    def rename(content: dict[str, Any]) -> None:
        for segment in content["annotations"][0]["segments_info"]:
            segment["label_id"] = segment.pop("category_id")
            segment["was_fused"] = False
            segment["score"] = None

    expected = [segment.class_id for segment in open_scene(folder).frames[0].read_mask(None).segments]
    change(folder, rename)
    segments = open_scene(folder).frames[0].read_mask(None).segments
    assert [segment.class_id for segment in segments] == expected
    assert {segment.score for segment in segments} == {1.0}


def test_coco_masks_find_their_frames_by_the_images_list(folder: Path) -> None:
    def rename(content: dict[str, Any]) -> None:
        content["images"] = [{"id": i, "file_name": f"color/{i:04d}.jpg"} for i in range(3)]
        for i, annotation in enumerate(content["annotations"]):
            (folder / "panoptic" / f"{i:04d}.png").rename(folder / "panoptic" / f"mask_{i}.png")
            annotation.update(image_id=i, file_name=f"mask_{i}.png")

    change(folder, rename)
    assert [frame.name for frame in open_scene(folder).frames] == ["0000", "0001", "0002"]


def test_coco_annotations_of_other_images_are_skipped(folder: Path) -> None:
    other = {"image_id": "x", "file_name": "elsewhere.png", "segments_info": "whatever"}
    change(folder, lambda c: c["annotations"].append(other))
    assert check_scene(open_scene(folder)) == ()


def test_a_grey_coco_png_holds_the_ids_themselves(folder: Path) -> None:
    mask = open_scene(folder).frames[1].read_mask(None)
    cv2.imwrite(str(folder / "panoptic" / "0001.png"), mask.ids.astype(np.uint16))
    np.testing.assert_array_equal(open_scene(folder).frames[1].read_mask(None).ids, mask.ids)
