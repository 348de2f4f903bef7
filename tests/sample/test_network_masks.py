"""The sample's masks: made by the program from the seed, faulty in every way a network is, and well-formed."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import class_belief
import cv2
import mask_noise
import network_masks
import numpy as np
import pytest
from numpy.typing import NDArray

ROOM = Path(__file__).resolve().parents[2] / "sample" / "room"
SEED = 0
HEIGHT, WIDTH = 120, 160
IS_THING = {"wall": False, "floor": False, "rug": False, "door": False, "window": False, "cabinet": True, "table": True,
            "chair": True, "sofa": True, "bed": True, "object": True, "ceiling": False}  # fmt: skip


def committed() -> dict[str, Any]:
    table: dict[str, Any] = json.loads((ROOM / "panoptic.json").read_text())
    return table


def committed_ids(file_name: str) -> NDArray[np.int32]:
    picture = cv2.imread(str(ROOM / "panoptic" / file_name), cv2.IMREAD_COLOR).astype(np.int32)
    return picture[..., 2] + 256 * picture[..., 1] + 65536 * picture[..., 0]


def true_classes(file_name: str) -> NDArray[np.int64]:
    return cv2.imread(str(ROOM / "gt/semantic" / file_name), cv2.IMREAD_UNCHANGED).astype(np.int64)


def square(top: int, left: int, size: int = 30) -> NDArray[np.bool_]:
    pixels = np.zeros((HEIGHT, WIDTH), bool)
    pixels[top : top + size, left : left + size] = True
    return pixels


def view(*things: NDArray[np.bool_], kind: str = "chair") -> list[Any]:
    """A wall and things of one class in front of it, seen from the front."""

    def region(key: str, name: str, pixels: NDArray[np.bool_]) -> Any:
        share = float(pixels.mean())
        sight = class_belief.Sight(key, name, IS_THING[name], share, (1.0, 2.0, 0.5), (0.0, 1.0, 0.0))
        return mask_noise.TrueRegion(pixels, sight)

    wall = ~np.any(np.stack(things), axis=0)
    return [region("wall", "wall", wall), *(region(f"thing {k}", kind, pixels) for k, pixels in enumerate(things))]


def quiet(**faults: Any) -> Any:
    """A network without any fault but the named ones."""
    certain = class_belief.BeliefNoise(thing_margin=50.0, stuff_margin=50.0)
    still = {"missed": 0.0, "split": 0.0, "merged": 0.0, "invented": 0.0, "edge_warp": 0.0, "bleed": 0.0,
             "stuff_void": 0.0, "unsure_below": 0.0}  # fmt: skip
    return mask_noise.MaskNoise(**{"belief": certain, **still, **faults})


def detect(regions: list[Any], noise: Any, frame: str = "0000") -> tuple[Any, list[Any]]:
    ids, seen = mask_noise.detect(regions, IS_THING, noise, SEED, frame)
    return ids, seen


def names(seen: list[Any]) -> list[str]:
    return sorted(region.class_name for region in seen)


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


def test_confusions_name_known_classes() -> None:
    known = {entry["name"] for entry in committed()["categories"]}
    for name, rivals in class_belief.CONFUSIONS.items():
        assert name in known and set(rivals) <= known - {name}
    assert set(class_belief.CONFUSIONS) == known


def test_every_rate_is_documented() -> None:
    for noise in (mask_noise.MaskNoise(), class_belief.BeliefNoise()):
        assert all(getattr(noise, field.name) is not None for field in fields(noise))
        with pytest.raises(AttributeError):
            setattr(noise, fields(noise)[0].name, 0)


def test_a_faultless_detector_sees_what_is_there() -> None:
    regions = view(square(20, 20), square(60, 100))
    ids, seen = detect(regions, quiet())
    assert names(seen) == ["chair", "chair", "wall"]
    for region in regions[1:]:
        assert len(np.unique(ids[region.pixels][100:-100])) == 1
        assert (np.isin(ids, np.unique(ids[region.pixels])) & region.pixels).sum() > 0.95 * region.pixels.sum()


def test_ids_are_new_in_every_view() -> None:
    regions = view(square(20, 20), square(60, 100))
    drawn = {int(detect(regions, quiet(), f"{k:04d}")[0][35, 35]) for k in range(12)}
    assert len(drawn) > 1


def test_missed_things_leave_a_hole_or_are_swallowed() -> None:
    regions = view(square(20, 20))
    ids, seen = detect(regions, quiet(missed=1.0, missed_as_void=1.0))
    assert names(seen) == ["wall"] and (ids[25:45, 25:45] == 0).all()
    ids, seen = detect(regions, quiet(missed=1.0, missed_as_void=0.0))
    assert names(seen) == ["wall"] and (ids == 1).all()


def test_small_things_are_not_found() -> None:
    assert names(detect(view(square(20, 20, 5)), quiet())[1]) == ["wall"]


def test_split_segments_cover_the_thing_together() -> None:
    ids, seen = detect(view(square(20, 20)), quiet(split=1.0, split_disagrees=0.0))
    assert names(seen) == ["chair", "chair", "wall"]
    parts = [region.pixels.sum() for region in seen if region.class_name == "chair"]
    assert min(parts) > 50 and abs(sum(parts) - 900) < 90


def test_touching_things_of_a_class_are_merged_and_distant_ones_never() -> None:
    merging = quiet(merged=1.0)
    assert names(detect(view(square(20, 20), square(20, 51)), merging)[1]) == ["chair", "wall"]
    assert len(detect(view(square(20, 20), square(20, 90)), merging)[1]) == 3


def test_segments_are_invented_with_low_scores() -> None:
    _, seen = detect(view(square(20, 20)), quiet(invented=5.0))
    invented = [region for region in seen if region.is_thing and region.score < 0.7]
    assert invented and len(seen) > 2


def test_edges_wander_by_a_few_pixels_only() -> None:
    ids, _ = detect(view(square(30, 40, 60)), quiet(edge_warp=1.6, bleed=0.12))
    wrong = (ids == ids[60, 70]) != square(30, 40, 60)
    inside, outside = square(36, 46, 48), square(24, 34, 72)
    assert 30 < wrong.sum() < 800
    assert not wrong[inside].any() and not wrong[~outside].any()


def test_stuff_is_partly_void_and_things_are_not() -> None:
    ids, _ = detect(view(square(30, 40, 40)), quiet(stuff_void=0.2))
    assert 0.1 < (ids == 0).mean() < 0.25
    assert (ids[32:68, 42:78] != 0).all()


def test_belief_turns_slowly_and_errs_with_the_class_that_is_alike() -> None:
    belief = class_belief
    noise = belief.BeliefNoise(flicker=0.0, thing_margin=0.5)
    front = belief.Sight("thing 1", "sofa", True, 0.05, (0.0, 0.0, 0.5), (0.0, 1.0, 0.0))
    beliefs = []
    for degrees in range(360):
        angle = np.radians(degrees)
        sight = replace(front, direction=(float(np.sin(angle)), float(np.cos(angle)), 0.0))
        beliefs.append(belief.believe(sight, noise, SEED, f"{degrees}")[0])
    changes = sum(a != b for a, b in zip(beliefs, beliefs[1:], strict=False))
    assert set(beliefs) <= {"sofa", "bed", "chair"} and 1 < len(set(beliefs))
    assert 1 <= changes <= 24  # stretches of 15 degrees and more, no dice


def test_wrong_beliefs_score_lower_but_not_always() -> None:
    scores: dict[bool, list[float]] = {True: [], False: []}
    true = {entry["id"]: entry["name"] for entry in committed()["categories"]}
    for annotation in committed()["annotations"]:
        ids = committed_ids(annotation["file_name"])
        semantic = true_classes(annotation["file_name"])
        for segment in annotation["segments_info"]:
            major = int(np.bincount(semantic[ids == segment["id"]]).argmax())
            if major in true:
                scores[major == segment["category_id"]].append(segment["score"])
    assert 0.05 < len(scores[False]) / (len(scores[True]) + len(scores[False])) < 0.6
    assert np.mean(scores[False]) < np.mean(scores[True]) - 0.1
    assert np.quantile(scores[False], 0.9) > np.median(scores[True]) - 0.2


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
