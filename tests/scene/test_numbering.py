"""Numbers of one table that are counted in several ways: told by the masks, asked for by name, or assumed aloud."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.json_file import to_text
from engine.records import to_json
from engine.scene import list_classes, open_scene
from engine.scene.class_tables import known_table
from engine.scene.report import write_class_list
from engine.scene_source import SceneSource
from tests.scene.mask_formats.labelled_room import (
    COCO_NAMES,
    COCO_NUMBERS,
    NAMES,
    Truth,
    check_on_room,
    write_masked_frames,
)
from tests.scene.mask_formats.test_segment_maps import write_detectron2
from tests.scene.refusing import refuses

ADE = {1: 0, 2: 3, 3: 10, 5: 19, 13: 5}
"""The room's classes in ADE20K, counted from 0."""
ADE_DATA = {class_id: number + 1 for class_id, number in ADE.items()}
COCO_DATA = {1: 199, 2: 190, 3: 188, 5: 62, 13: 186}
NYU40 = {1: 1, 2: 2, 3: 3, 5: 5, 13: 22}
NYU13 = {1: 12, 2: 5, 3: 6, 5: 4, 13: 3}
RAW = {1: 1, 2: 3, 3: 75, 5: 2, 13: 41}
"""ScanNet's raw ids."""
TREES = {1: "sky", 2: "building", 3: "tree"}
TRAFFIC = {1: "building", 2: "road", 3: "car", 5: "pole", 13: "sky"}


def in_table(table: str, names: Mapping[int, str]) -> dict[int, int]:
    number = {label.name: label.id for label in known_table(table).labels}
    return {class_id: number[name] for class_id, name in names.items()}


def write_labels(folder: Path, numbers: Mapping[int, int], void: int = 255) -> list[Truth]:
    """Arrays of classes; those without a number, and the uppermost rows, are void."""
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        truth.semantic[:2], truth.instance[:2] = 0, 0
        shown = np.vectorize(lambda class_id: numbers.get(class_id, void))(truth.semantic)
        np.save(masks / f"{truth.name}.npy", shown.astype(np.uint8))
        truth.semantic[~np.isin(truth.semantic, [*numbers])] = 0
    return truths


@pytest.mark.parametrize(
    ("classes", "numbers", "told"),
    [
        ("nyu40", NYU13, "other-numbers nyu13:1-13 nyu40 ceiling --classes nyu40:1-40"),
        ("nyu40", RAW, "other-numbers scannet:1-1357 nyu40 75 --classes"),
        ("scannet", NYU40, "other-numbers nyu40:1-40 scannet --classes scannet:1-1357"),
    ],
)
def test_mask_numbers_that_contradict_the_named_table_are_refused(
    tmp_path: Path, classes: str, numbers: dict[int, int], told: str
) -> None:
    write_labels(tmp_path, numbers, void=0)
    assert refuses(f"{told} masks", tmp_path, classes=classes).option == "--classes"


def warned(folder: Path, classes: str) -> list[str]:
    return [one for one in open_scene(folder, classes=classes).warnings if "numbers are read as" in one]


@pytest.mark.parametrize(
    ("classes", "numbers", "void", "names", "read_as", "told"),
    [
        ("ade20k", ADE, 255, NAMES, "", ""),
        ("ade20k", ADE_DATA, 0, NAMES, "ade20k:1-150", "% of the pixels are then ceiling, floor, wall"),
        ("ade20k", ADE_DATA | {5: 150}, 0, NAMES | {5: "flag"}, "ade20k:1-150", "this alone has the numbers 150"),
        ("ade20k", {3: 20}, 255, {3: "car"}, "ade20k:0-149", "their content does not show it"),
        ("ade20k:1-150", {3: 20}, 0, {3: "chair"}, "", ""),
        ("coco", COCO_NUMBERS, 255, COCO_NAMES, "", ""),
        ("coco", COCO_DATA, 0, COCO_NAMES, "coco:90", "this alone has the numbers 18"),
        ("coco", {3: 62, 5: 63}, 0, {3: "chair", 5: "couch"}, "coco:90", "of the pixels are then "),
        ("coco", {3: 44, 5: 47}, 255, {3: "spoon", 5: "apple"}, "coco:0-132", "name --classes coco:90"),
        ("nyu40", NYU40, 0, NAMES, "", ""),
        ("nyu40", {1: 0, 2: 1, 3: 0, 5: 4}, 255, NAMES | {3: "wall"}, "nyu40:0-39", "then ceiling, floor, wall"),
        ("nyu40", {3: 7, 5: 6}, 0, {3: "table", 5: "sofa"}, "nyu40:1-40", "--classes nyu40:0-39 or --classes scan"),
        ("nyu13", NYU13, 0, NAMES | {3: "furniture"}, "", ""),
        ("scannet", RAW, 0, NAMES | {3: "file cabinet"}, "", ""),
        ("cityscapes", in_table("cityscapes:0-33", TRAFFIC), 4, TRAFFIC, "cityscapes:0-33", "this alone has"),
        ("cityscapes", in_table("cityscapes", TRAFFIC), 255, TRAFFIC, "", ""),
    ],
)  # fmt: skip
def test_an_assumed_class_numbering_gives_a_warning(
    tmp_path: Path, classes: str, numbers: dict[int, int], void: int, names: dict[int, str], read_as: str, told: str
) -> None:
    truths = write_labels(tmp_path, numbers, void)
    check_on_room(open_scene(tmp_path, classes=classes), truths, names | {0: ""}, frozenset())
    warnings = warned(tmp_path, classes)
    assert len(warnings) == bool(read_as)
    assert all(f"read as {read_as}:" in one and told in one and "--classes " in one for one in warnings)


@pytest.mark.parametrize(
    ("classes", "numbers", "void", "look_like"),
    [
        ("nyu40:1-40", NYU13, 0, "nyu13:1-13"),
        ("nyu13:0-12", {1: 1, 2: 2, 3: 3, 5: 5}, 0, "nyu40:1-40"),
        ("ade20k:0-149", ADE_DATA, 0, "ade20k:1-150"),
        ("coco:90", ADE, 255, "ade20k:0-149"),
        ("ade20k", COCO_NUMBERS, 255, "coco:0-132"),
        ("cityscapes:0-33", {1: 12, 2: 5, 3: 6, 5: 4}, 0, "nyu13:1-13"),
        ("scannet200", ADE_DATA | {1: 1, 2: 4, 3: 2}, 0, "ade20k:1-150"),
    ],
)
def test_a_doubtful_class_table_gives_a_warning(
    tmp_path: Path, classes: str, numbers: dict[int, int], void: int, look_like: str
) -> None:
    write_labels(tmp_path, numbers, void)
    (told,) = warned(tmp_path, classes)
    assert f", but look like {look_like}" in told and f"if that is right, name --classes {look_like}" in told
    assert not [one for one in warned(tmp_path, look_like) if "but look like" in one]


def test_the_place_of_sky_tells_street_classes_from_room_classes(tmp_path: Path) -> None:
    """A building, the sky and trees in ADE20K have the numbers of a wall, a floor and a bed in NYU40."""
    masks, _ = write_masked_frames(tmp_path)
    street = np.repeat(np.array([2, 1, 4], np.uint8), (24, 12, 12))[:, None].repeat(64, 1)
    for shown, name in ((street, "street"), (street[::-1], "room")):
        for path in sorted((tmp_path / "color").iterdir()):
            np.save(masks / f"{path.stem}.npy", shown)
        assert ("look like nyu40:1-40" in str(warned(tmp_path, "ade20k:0-149"))) == (name == "room")


@pytest.mark.parametrize("turns", [1, 3])
def test_masks_of_a_street_on_its_side_are_not_taken_for_a_room(tmp_path: Path, turns: int) -> None:
    """As phones held upright record it. With one more, these numbers are a wall, a floor and a ceiling."""
    masks, _ = write_masked_frames(tmp_path)
    street = np.rot90(np.repeat(np.array([2, 1, 4, 6], np.uint8), 16)[:, None].repeat(48, 1), turns)
    for path in sorted((tmp_path / "color").iterdir()):
        np.save(masks / f"{path.stem}.npy", street)
    opened = open_scene(tmp_path, classes="ade20k")
    shown = {opened.classes[one.class_id].name for one in opened.frames[0].mask().segments}
    assert shown == {"sky", "building", "tree", "road"}


def test_classes_toml_can_name_the_numbering_of_the_masks(tmp_path: Path) -> None:
    truths = write_labels(tmp_path, ADE_DATA, void=0)
    (tmp_path / "masks" / "classes.toml").write_text('table = "ade20k:1-150"\n')
    check_on_room(open_scene(tmp_path), truths, NAMES | {0: ""}, frozenset())
    (tmp_path / "masks" / "classes.toml").write_text('table = "ade20k:0-149"\nvoid = [255]\n')
    assert "look like ade20k:1-150" in str(open_scene(tmp_path).warnings)
    np.save(tmp_path / "masks" / "0001.npy", np.full((48, 64), 150, np.uint8))
    with pytest.raises(Exception, match=r"class ids 150 are not in .*, or name --classes ade20k:1-150"):
        open_scene(tmp_path).frames[1].mask()


def apart(class_id: int) -> int:
    return COCO_NUMBERS[class_id] - (0 if class_id == 5 else 79)


def test_separate_stuff_numbers_of_detectron2_are_recognised(tmp_path: Path) -> None:
    """No number is both a thing's and stuff's: the wall is 52, a hot dog; the floor 43, a knife."""
    truths = write_detectron2(tmp_path, {class_id: apart(class_id) for class_id in COCO_NUMBERS}, {5})
    names, chairs = COCO_NAMES | {0: ""}, frozenset({"chair"})
    check_on_room(open_scene(tmp_path, classes="coco"), truths, names, chairs)
    assert "stuff numbered apart from things: this alone fits" in warned(tmp_path, "coco")[0]
    refuses("isthing-contradicts ade20k --classes", tmp_path, classes="ade20k")
    source, edited = SceneSource(tmp_path), tmp_path / "edited.json"
    listed = list_classes(source, "coco")
    rows = tuple(replace(row, into="floor") if row.name.startswith("floor") else row for row in listed.rows)
    edited.write_text(to_text(to_json(replace(listed, rows=rows))))
    write_class_list(source, edited)
    check_on_room(open_scene(tmp_path), truths, names | {2: "floor"}, chairs)


def test_a_table_that_contradicts_the_masks_things_is_refused(tmp_path: Path) -> None:
    """Of Cityscapes' numbers, 13 is a car; the files say it is stuff."""
    numbers = {1: 13, 2: 0, 3: 1, 5: 11, 13: 10}
    truths = write_detectron2(tmp_path, numbers, {5})
    told = "isthing-contradicts cityscapes car there stuff"
    refuses(told, tmp_path, classes="cityscapes")
    (tmp_path / "masks" / "classes.toml").write_text('table = "cityscapes"\n[[class]]\nid = 13\nthing = false\n')
    names = {1: "car", 2: "road", 3: "sidewalk", 5: "person", 13: "sky", 0: ""}
    check_on_room(open_scene(tmp_path), truths, names, frozenset({"person"}))


def test_a_class_list_starts_with_the_numbers_in_the_masks(tmp_path: Path) -> None:
    write_labels(tmp_path, ADE_DATA, void=0)
    assert list_classes(SceneSource(tmp_path), "ade20k").rows[0].label == 1
