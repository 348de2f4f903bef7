"""A mask, a class and a score a detection: as instance networks give them, in an .npz or as pictures."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.mask_formats.labelled_room import (
    NAMES,
    Truth,
    write_frames,
    write_masked_frames,
)

COCO = {3: 72, 5: 56}
"""Of COCO's things: the cabinet seen as a refrigerator, the chair."""
SEEN = {1: "", 2: "", 3: "refrigerator", 5: "chair", 13: ""}


def detected(truth: Truth) -> Iterator[tuple[int, float, np.ndarray]]:
    """True objects at 0.9, and beneath each a worse one that is larger and of another class."""
    for class_id, number, region in truth.regions():
        if number:
            larger = cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            inside = larger & np.isin(truth.instance, [number])
            yield class_id, 0.9, region
            yield 8 - class_id, 0.25, inside


KEYS = ("masks", "classes", "scores")


def write_stacks(folder: Path, as_names: bool = False, keys: tuple[str, str, str] = KEYS) -> list[Truth]:
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        found = list(detected(truth))
        classes = [NAMES[one] if as_names else COCO[one] for one, _, _ in found]
        stack = np.array([mask for _, _, mask in found]).reshape(-1, 48, 64)
        scores = np.array([score for _, score, _ in found], np.float32)
        arrays = dict(zip(keys, (stack, np.array(classes, None if classes else np.int64), scores), strict=True))
        np.savez(masks / f"{truth.name}.npz", boxes=np.zeros((len(found), 4)), **arrays)
    return truths


def write_pictures(folder: Path) -> list[Truth]:
    scene, truths = write_frames(folder)
    for truth in truths:
        (scene / "masks" / truth.name).mkdir(parents=True)
        for k, (class_id, score, mask) in enumerate(detected(truth)):
            path = scene / "masks" / truth.name / f"{k}_{NAMES[class_id]}_{score}.png"
            cv2.imwrite(str(path), mask.astype(np.uint8) * 255)
    return truths


def write_tracks(folder: Path, keys: Mapping[str, str], names: bool) -> list[Truth]:
    """The arrays that SAM 3 gives for each frame of a video, saved as they are."""
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        found = [(class_id, number, region) for class_id, number, region in truth.regions() if number]
        arrays = {
            keys["tracks"]: np.array([number for _, number, _ in found], np.int64),
            keys["masks"]: np.array([region for _, _, region in found], bool).reshape(-1, 48, 64),
            keys["scores"]: np.full(len(found), 0.75, np.float32),
        }
        if names:
            arrays["classes"] = np.array([NAMES[class_id] for class_id, _, _ in found], None if found else "U1")
        np.savez(masks / f"{truth.name}.npz", **arrays)
    return truths


HUGGING_FACE = {"tracks": "object_ids", "masks": "masks", "scores": "scores"}
SAM_3 = {"tracks": "out_obj_ids", "masks": "out_binary_masks", "scores": "out_probs"}


@pytest.mark.parametrize("keys", [HUGGING_FACE, SAM_3])
def test_a_track_of_sam_3_is_one_object_in_all_frames(tmp_path: Path, keys: Mapping[str, str]) -> None:
    truths = write_tracks(tmp_path, keys, names=False)
    scene = open_scene(tmp_path)
    assert [each.name for each in scene.classes.categories] == ["object"]
    for truth, frame in zip(truths, scene.frames, strict=True):
        mask = frame.read_mask(None)
        of_track = {one.track: mask.ids == one.id for one in mask.segments}
        regions = {number: region for _, number, region in truth.regions() if number}
        assert of_track.keys() == regions.keys()
        assert all((of_track[number] == region).all() for number, region in regions.items())
