"""The sample's masks: made by the program from the seed, well-formed, and about half right."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import mask_noise
import network_masks
import numpy as np
import pytest
from numpy.typing import NDArray

ROOM = Path(__file__).resolve().parents[2] / "sample" / "room"
SEED = 0


def committed() -> dict[str, Any]:
    table: dict[str, Any] = json.loads((ROOM / "panoptic.json").read_text())
    return table


def committed_ids(file_name: str) -> NDArray[np.int32]:
    picture = cv2.imread(str(ROOM / "panoptic" / file_name), cv2.IMREAD_COLOR).astype(np.int32)
    return picture[..., 2] + 256 * picture[..., 1] + 65536 * picture[..., 0]


def true_classes(file_name: str) -> NDArray[np.int64]:
    return cv2.imread(str(ROOM / "gt/semantic" / file_name), cv2.IMREAD_UNCHANGED).astype(np.int64)


def test_committed_masks_are_what_the_program_makes() -> None:
    check_frames(committed()["annotations"][5::24])


@pytest.mark.slow
def test_all_committed_masks_are_what_the_program_makes() -> None:
    check_frames(committed()["annotations"])


def check_frames(annotations: list[dict[str, Any]]) -> None:
    categories, noise = committed()["categories"], mask_noise.MaskNoise()
    for annotation in annotations:
        ids, segments = network_masks.mask_of_frame(ROOM, annotation["image_id"], categories, SEED, noise)
        np.testing.assert_array_equal(ids, committed_ids(annotation["file_name"]))
        assert segments == annotation["segments_info"]


def test_the_program_writes_the_same_twice(tmp_path: Path) -> None:
    for name in ("semantic", "instance"):
        (tmp_path / "gt" / name).mkdir(parents=True)
        (tmp_path / "gt" / name / "0030.png").write_bytes((ROOM / "gt" / name / "0030.png").read_bytes())
    (tmp_path / "gt/classes.json").write_text((ROOM / "gt/classes.json").read_text())
    for name in ("depth/0030.png", "pose/0030.txt", "intrinsic/intrinsic_color.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((ROOM / name).read_bytes())
    for out in ("a", "b"):
        network_masks.write_masks(tmp_path, tmp_path / out, SEED)
    network_masks.write_masks(tmp_path, tmp_path / "other", SEED + 1)
    written = {out: (tmp_path / out / "panoptic/0030.png").read_bytes() for out in ("a", "b", "other")}
    assert written["a"] == written["b"] != written["other"]
    assert (tmp_path / "a/panoptic.json").read_text() == (tmp_path / "b/panoptic.json").read_text()


def test_committed_masks_are_coco_panoptic() -> None:
    table = committed()
    things = {entry["id"]: entry["isthing"] for entry in table["categories"]}
    splits = json.loads((ROOM / "splits.json").read_text())
    assert [image["id"] for image in table["images"]] == sorted(splits["train"] + splits["test"])
    assert len(table["annotations"]) == len(table["images"]) == len(list((ROOM / "color").glob("*.jpg")))
    for annotation in table["annotations"]:
        segments = annotation["segments_info"]
        ids, counts = np.unique(committed_ids(annotation["file_name"]), return_counts=True)
        painted = {int(i): int(n) for i, n in zip(ids, counts, strict=True) if i}
        assert painted == {segment["id"]: segment["area"] for segment in segments}
        for segment in segments:
            assert segment["isthing"] == things[segment["category_id"]]
            assert 0 < segment["score"] < 1 and segment["iscrowd"] == 0


def test_masks_alone_are_about_half_right() -> None:
    """Mean IoU over all frames and classes that occur: what the lift starts from."""
    table = committed()
    size = max(entry["id"] for entry in table["categories"]) + 1
    confusion = np.zeros((size, size))
    for annotation in table["annotations"]:
        ids = committed_ids(annotation["file_name"])
        classes = np.zeros(int(ids.max()) + 1, np.int64)
        for segment in annotation["segments_info"]:
            classes[segment["id"]] = segment["category_id"]
        semantic = true_classes(annotation["file_name"])
        known = semantic > 0
        pairs = semantic[known] * size + classes[ids][known]
        confusion += np.bincount(pairs, minlength=size * size).reshape(size, size)
    right = np.diag(confusion)[1:]
    union = confusion.sum(0)[1:] + confusion.sum(1)[1:] - right
    assert 0.45 < (right / union).mean() < 0.60
