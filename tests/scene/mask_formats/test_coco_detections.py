"""Detections in COCO's JSON: each kind of file by itself, and over masks, where they overlap."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pycocotools import mask as rle_tools

from engine.scene import Evidence, PanopticMask, Scene, Segment, open_scene
from engine.scene_of_lift import digest_of_masks
from tests.raises_key import raises_key
from tests.scene.mask_formats.labelled_room import NAMES, SIZE, THINGS, Truth, check_on_room, write_frames
from tests.tiny_scene import write_tiny_scene

CATEGORIES = [{"id": number, "name": name} for number, name in NAMES.items()]


def compressed(mask: np.ndarray) -> dict[str, Any]:
    """As pycocotools, detectron2 and ultralytics write it."""
    runs = rle_tools.encode(np.asfortranarray(mask, np.uint8))
    return {"size": runs["size"], "counts": runs["counts"].decode()}


def whole(mask: np.ndarray) -> dict[str, Any]:
    """Column by column: how many pixels are outside, then inside, and so on."""
    column = mask.ravel(order="F")
    edges = np.flatnonzero(np.diff(np.concatenate([[False], column]).astype(int)))
    return {"size": [*mask.shape], "counts": np.diff([0, *edges, len(column)]).tolist()}


def polygons(mask: np.ndarray) -> list[list[float]]:
    """The outline of each run of pixels in a row: exact, whatever the shape."""
    steps = np.diff(np.pad(mask.astype(int), ((0, 0), (1, 1))))
    runs = zip(np.argwhere(steps == 1).tolist(), np.argwhere(steps == -1).tolist(), strict=True)
    return [[x, y, end, y, end, y + 1, x, y + 1] for (y, x), (_, end) in runs]


def detected(truth: Truth, pack: Any = compressed) -> Iterator[dict[str, Any]]:
    for class_id, _, mask in truth.regions():
        yield {"category_id": class_id, "score": 0.9, "segmentation": pack(mask), "bbox": [0, 0, 1, 1]}


def results(truths: list[Truth], pack: Any = compressed) -> list[dict[str, Any]]:
    """One list for all frames, whose ids are numbers."""
    return [{"image_id": int(truth.name), **one} for truth in truths for one in detected(truth, pack)]


def instances(truths: list[Truth], name: str = "file_name", pack: Any = polygons) -> dict[str, Any]:
    """Annotations with images and categories, and no scores, as COCO's (``file_name``) and LVIS's (``coco_url``)."""
    images = [
        {"id": 100 + n, name: f"http://images.cocodataset.org/train2017/{truth.name}.jpg", "width": 64, "height": 48}
        for n, truth in enumerate(truths)
    ]
    found = [
        {key: value for key, value in {**one, "image_id": 100 + n, "id": n, "iscrowd": 0}.items() if key != "score"}
        for n, truth in enumerate(truths) for one in detected(truth, pack)
    ]  # fmt: skip
    return {"images": images, "annotations": found, "categories": CATEGORIES}


def wrote(path: Path, content: Any) -> Path:
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("pack", [compressed, whole])
def test_coco_results_are_read_with_a_class_table(tmp_path: Path, pack: Any) -> None:
    _, truths = write_frames(tmp_path)
    masks = wrote(tmp_path / "predictions.json", results(truths, pack))
    row = '[[class]]\nid = {}\nname = "{}"\nthing = {}\n'
    rows = (row.format(number, name, str(name in THINGS).lower()) for number, name in NAMES.items())
    (tmp_path / "classes.toml").write_text("".join(rows))
    check_on_room(open_scene(tmp_path, masks), truths)


@pytest.mark.parametrize("name", ["file_name", "coco_url"])
def test_coco_instances_bring_their_class_names(tmp_path: Path, name: str) -> None:
    _, truths = write_frames(tmp_path)
    for pack in (polygons, compressed):
        masks = wrote(tmp_path / "instances.json", instances(truths, name, pack))
        check_on_room(open_scene(tmp_path, masks), truths)


def test_sam_and_sa_v_detections_number_objects(tmp_path: Path) -> None:
    _, truths = write_frames(tmp_path)
    found = {truth.name: [mask for _, _, mask in truth.regions()] for truth in truths}
    for name, masks in found.items():
        regions = [{"segmentation": compressed(mask), "predicted_iou": 1.01, "area": int(mask.sum())} for mask in masks]
        wrote(tmp_path / "regions" / f"{name}.json", regions)
    masklets = [[compressed(mask) for mask in each] for each in found.values()]
    video = wrote(tmp_path / "video.json", {"masklet": masklets})
    for place, tracks in ((tmp_path / "regions", None), (video, 1)):
        scene = open_scene(tmp_path, place)
        assert [each.name for each in scene.classes.categories] == ["object"]
        first = scene.frames[0].mask()
        assert len(first.segments) == len(found["0000"]) and first.segments[0].track == tracks
        for segment, mask in zip(first.segments, found["0000"], strict=True):
            assert np.array_equal(first.ids == segment.id, mask)


def over_the_tiny_scene(folder: Path, content: Any, name: str = "found.json") -> Scene:
    return open_scene(folder, detections=wrote(folder.parent / name, content))


def a_detection(mask: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"image_id": 1, "category_id": 5, "score": 0.4, "segmentation": compressed(mask), **more}


@pytest.fixture
def room(tmp_path: Path) -> Path:
    write_tiny_scene(tmp_path / "room", frames=3, size=SIZE)
    return tmp_path / "room"


def test_detections_given_with_masks_leave_the_masks_unchanged(room: Path) -> None:
    """Their classes are the masks' by name or number; others are told and added; weak ones and crowds do not count."""
    left, upper = np.zeros((2, 48, 64), bool)
    left[:, :40], upper[:30] = True, True
    before = open_scene(room)
    found = [
        a_detection(left), a_detection(upper, score=0.8), a_detection(upper, score=0.05), a_detection(left, iscrowd=1),
        a_detection(left, category_id=77, score=0.3),
    ]  # fmt: skip
    named = {"annotations": found, "categories": [{"id": 5, "name": "Chair"}, {"id": 77, "name": "house plant"}]}
    scene = over_the_tiny_scene(room, named)
    assert [frame.read_detections is None for frame in scene.frames] == [True, False, True]
    assert np.array_equal(scene.frames[1].mask().ids, before.frames[1].mask().ids)
    plant = next(each for each in scene.classes.categories if each.name == "house plant")
    assert any("house plant" in told for told in scene.warnings) and plant.id not in before.classes
    layers = scene.frames[1].layers()
    assert [[(one.class_id, one.score) for one in layer.segments] for layer in layers] == [
        [(5, 0.8)], [(5, 0.4)], [(plant.id, 0.3)],
    ]  # fmt: skip
    assert np.array_equal(layers[0].ids > 0, upper) and np.array_equal(layers[1].ids > 0, left)
    assert scene.frames[1].layers((32, 24))[0].ids.shape == (24, 32)
    assert len({digest_of_masks(each) for each in (before, scene, over_the_tiny_scene(room, found[:1]))}) == 3


def test_several_classes_of_a_detection_share_its_vote(room: Path) -> None:
    """As entries with the same mask, or as scores by category id."""
    upper, left = np.zeros((2, 48, 64), bool)
    upper[:30], left[:, :9] = True, True
    one = a_detection(upper, score=0.6)
    names = [{"id": 5, "name": "chair"}, {"id": 77, "name": "house plant"}]
    for both in ([one, one | {"category_id": 77, "score": 0.2}], [one | {"scores": {"5": 0.6, "77": 0.2}}]):
        scene = over_the_tiny_scene(room, {"annotations": [*both, a_detection(left)], "categories": names})
        segments = [one for layer in scene.frames[1].layers() for one in layer.segments]
        assert [one.score for one in segments] == [0.6, 0.4, 0.2]
        assert [one.share for one in segments] == pytest.approx([0.75, 1.0, 0.25])
        assert segments[0].class_id == segments[1].class_id != segments[2].class_id
    for wrong in ([0.6, 0.2], {}, {"chair": 0.6}):
        with raises_key("wrong-type scores"):
            over_the_tiny_scene(room, {"annotations": [one | {"scores": wrong}], "categories": names})


def chairs(room: Path, shift: int = 0, **more: Any) -> list[dict[str, Any]]:
    """Each frame's chair, with the frame's number as the picture's id."""
    masks = [frame.mask() for frame in open_scene(room).frames]
    found = [np.isin(mask.ids, [one.id for one in mask.segments if one.class_id == 5]) for mask in masks]
    return [a_detection(one, image_id=n + shift, **more) for n, one in enumerate(found)]


def agreement(scene: Scene, class_name: str = "chair") -> float:
    """The share of the detections' pixels where the masks show the class."""
    (number,) = [one.id for one in scene.classes.categories if one.name == class_name]
    layers = [(frame.mask(), layer) for frame in scene.frames for layer in frame.layers()]
    inside = [mask.class_map()[layer.ids > 0] == number for mask, layer in layers if layer.segments]
    assert all(one.class_id == number for _, layer in layers for one in layer.segments)
    return float(np.concatenate(inside).mean())


def test_detections_with_numbers_of_another_class_table_are_recognised(room: Path) -> None:
    """COCO's own id of a chair is 62, 5 in the room's masks."""
    scene = over_the_tiny_scene(room, chairs(room, category_id=62))
    assert agreement(scene) == 1.0 and any("coco:90" in told for told in scene.warnings)
    assert not any("coco" in told for told in over_the_tiny_scene(room, chairs(room)).warnings)
    assert any("only 0%" in told for told in over_the_tiny_scene(room, chairs(room, category_id=2)).warnings)


def test_image_ids_of_detections_are_matched_to_frames_by_content(room: Path) -> None:
    """The masks' table counts pictures from 1, the detections count as the frames' names do."""
    table = json.loads((room / "panoptic.json").read_text())
    table["images"] = [{"id": n + 1, "file_name": f"{n:04d}.jpg"} for n in range(3)]
    (room / "panoptic.json").write_text(json.dumps(table))
    for found in (
        chairs(room),
        chairs(room, 1),
        [{**one, "image_id": f"{one['image_id']:04d}.jpg"} for one in chairs(room)],
    ):
        assert agreement(over_the_tiny_scene(room, found)) == 1.0
    named = [{**one, "image_id": 77 + n, "file_name": f"{n:04d}.jpg"} for n, one in enumerate(chairs(room))]
    assert agreement(over_the_tiny_scene(room, named)) == 1.0


def test_detections_may_name_classes_in_words(room: Path) -> None:
    """As Grounded-SAM-2's demos write them, a file a picture."""
    for n, one in enumerate(chairs(room)):
        entry = {"class_name": "chair", "segmentation": one["segmentation"], "score": [0.5]}
        wrote(room.parent / "found" / f"{n:04d}.json", {"annotations": [entry], "img_width": 64, "img_height": 48})
    scene = open_scene(room, detections=room.parent / "found")
    assert agreement(scene) == 1.0 and scene.frames[0].layers()[0].segments[0].score == 0.5
    assert open_scene(room, room.parent / "found").classes.categories[0].name == "chair"
    alone = wrote(room.parent / "alone" / "predictions.json", chairs(room))
    assert agreement(open_scene(room, detections=alone.parent)) == 1.0


def along_rows(mask: np.ndarray) -> dict[str, Any]:
    return {"size": [*mask.shape], "counts": whole(mask.T)["counts"]}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda mask: along_rows(mask), "runs-along-rows"),
        (lambda mask: [[0.1, 0.1, 0.9, 0.1, 0.9, 0.9]], "normalised-polygons"),
        (lambda mask: {**compressed(mask), "size": [64, 48]}, "mask-shape"),
    ],
)
def test_detections_in_wrong_units_are_reported(room: Path, change: Any, told: str) -> None:
    found = [frame.mask().ids == one.id for frame in open_scene(room).frames for one in frame.mask().segments]
    with raises_key(told):
        over_the_tiny_scene(room, [a_detection(mask, segmentation=change(mask)) for mask in found])
    over_the_tiny_scene(room, [a_detection(mask, segmentation=whole(mask)) for mask in found])


def test_detections_of_pictures_that_are_not_frames_are_reported(room: Path) -> None:
    upper = np.ones((48, 64), bool)
    scene = over_the_tiny_scene(room, [a_detection(upper), a_detection(upper, image_id=987)])
    assert len(scene.frames[1].layers()) == 1 and any("987" in told for told in scene.warnings)


BAD: dict[str, tuple[Any, str]] = {
    "not a list": ("text", "not-detections"),
    "nothing of the kind": ({"info": 1}, "not-detections"),
    "a list of numbers": ([1, 2], "wrong-type annotations"),
    "no segmentation": ([{"image_id": 1, "category_id": 5}], "wrong-type segmentation"),
    "images of others": ([{"image_id": "street"}], "unknown-images street"),
    "a score of 2": (("score", 2), "wrong-type score"),
    "a class of nobody": (("category_id", 60), "unknown-classes 60"),
    "no class": (("category_id", None), "no-class-names"),
    "a negative class": (("category_id", -1), "wrong-type category_id"),
    "another shape": (("size", [64, 48]), "mask-shape 48x64"),
    "no size": (("size", [48]), "wrong-type size"),
    "a negative size": (("size", [-48, -64]), "wrong-type size"),
    "a huge size": (("size", [10**6, 10**6]), "bad-picture-size"),
    "negative runs": (("counts", [-1, 3073]), "wrong-type counts"),
    "huge runs": (("counts", [2**40]), "wrong-type counts"),
    "runs that end early": (("counts", [5, 5]), "bad-rle"),
    "runs in halves": (("counts", [0.5, 3071.5]), "wrong-type counts"),
    "a text that ends within a number": (("counts", "1o"), "bad-rle"),
    "other letters": (("counts", "\u00e9\u00e9"), "bad-rle"),
    "a polygon of two corners": (("segmentation", [[0, 0, 5, 5]]), "bad-polygon"),
    "a polygon of words": (("segmentation", [["a"] * 6]), "bad-polygon"),
    "no polygon": (("segmentation", []), "bad-polygon"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_detection_files_give_a_one_line_error(room: Path, case: str) -> None:
    content, told = BAD[case]
    if isinstance(content, tuple):
        one = a_detection(np.ones((48, 64), bool))
        inner = content[0] in ("size", "counts")
        one |= {"segmentation": one["segmentation"] | dict([content])} if inner else dict([content])
        content = [one]
    with raises_key(told):
        over_the_tiny_scene(room, content)


@pytest.mark.parametrize("text", ["", "0", "PPPPPP0", "0" * 300])
def test_run_lengths_that_do_not_fill_the_picture_are_refused(room: Path, text: str) -> None:
    given = {"segmentation": {"size": [48, 64], "counts": text}}
    if not text:
        with raises_key("bad-rle"):
            over_the_tiny_scene(room, [a_detection(np.ones((48, 64), bool), **given)])
        return
    scene = over_the_tiny_scene(room, [a_detection(np.ones((48, 64), bool), **given)])
    with raises_key("bad-rle found.json"):
        scene.frames[1].layers()


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_overlapping_detections_are_kept_in_layers(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    blurred = (cv2.blur(random.random((12, 16)), (5, 5)) for _ in range(count))
    inside = np.array([each > 0.5 for each in blurred])
    inside[:, 0, 0] = True  # no segment is empty
    segments = tuple(Segment(n, 1 + n % 3, True, float(random.random())) for n in range(1, count + 1))
    layers = Evidence(segments, inside).layers()
    held = {(one.class_id, one.score): layer.ids == one.id for layer in layers for one in layer.segments}
    assert len(held) == sum(len(layer.segments) for layer in layers) == count
    assert all(np.array_equal(held[one.class_id, one.score], mask) for one, mask in zip(segments, inside, strict=True))
    assert Evidence.of(layers[0]).layers()[0].segments == layers[0].segments
    ids = random.integers(0, 4, (12, 16)).astype(np.int32)
    picture = PanopticMask(ids, tuple(Segment(n, n, n > 1, 1.0) for n in (1, 2, 3)))
    (again,) = Evidence.of(picture).layers()
    assert np.array_equal(again.class_map(), picture.class_map())
