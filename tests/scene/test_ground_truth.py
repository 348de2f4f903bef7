"""Ground truth, and which classes its numbers mean."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import ClassTable, GroundTruth, Scene, load_view, open_scene
from engine.scene.class_map import class_map
from engine.scene.class_tables import known_table
from engine.scene.ground_truth import classes_by_name
from tests.scene.refusing import check_scene, refuses
from tests.scene.test_numbering import ADE, ADE_DATA, COCO_DATA, NYU13, NYU40, RAW
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path, frames=3, size=(32, 24))


def renumber(folder: Path, numbers: Mapping[int, int], void: int = 0) -> list[np.ndarray]:
    """Write the ground truth with other numbers; returns it as it was."""
    before = []
    for path in sorted((folder / "gt" / "semantic").iterdir()):
        before.append(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        shown = np.vectorize(lambda class_id: numbers.get(class_id, void))(before[-1])
        cv2.imwrite(str(path), shown.astype(np.uint16))
    return before


def check(folder: Path, before: list[np.ndarray], without: tuple[int, ...] = ()) -> tuple[str, ...]:
    """Assert that the ground truth is as it was, void in classes ``without``; returns the warnings."""
    scene = open_scene(folder)
    for frame, expected in zip(scene.frames, before, strict=True):
        assert frame.read_ground_truth is not None
        truth = frame.read_ground_truth(None)
        assert isinstance(truth, GroundTruth)
        np.testing.assert_array_equal(truth.semantic, np.where(np.isin(expected, without), 0, expected))
    return tuple(one for one in scene.warnings if "ground truth" in one)


@pytest.mark.parametrize(
    ("numbers", "table"),
    [
        (ADE, "ade20k:0-149"),
        (ADE_DATA, "ade20k:1-150"),
        (COCO_DATA, "coco:90"),
        ({key: number - 1 for key, number in NYU40.items()}, "nyu40:0-39"),
        (RAW, "scannet:1-1357"),
    ],
)
def test_ground_truth_in_numbers_of_another_table_is_refused(folder: Path, numbers: dict[int, int], table: str) -> None:
    renumber(folder, numbers, 255 if numbers is ADE else 0)
    refuses(f"truth-numbers {table} Write", folder)


def test_ground_truth_that_fits_no_class_table_is_reported(folder: Path) -> None:
    renumber(folder, {1: 150, 2: 151, 3: 152, 5: 153, 13: 154})
    (warning,) = [one for one in open_scene(folder).warnings if "ground truth" in one]
    assert "numbers are read as class ids of the masks: 0% of the pixels agree" in warning


@pytest.mark.parametrize(
    ("text", "name", "numbers", "told"),
    [
        ('table = "ade20k"', "semantic", ADE_DATA, "the ground truth's numbers are read as ade20k:1-150: "),
        ('table = "ade20k:1-150"', "semantic", ADE_DATA, ""),
        ("", "semantic_ade20k", ADE, ""),
        ("", "semantic_nyu40", NYU40, ""),
        ("", "semantic_scannet", RAW, ""),
    ],
)
def test_the_truths_own_table_is_used(folder: Path, text: str, name: str, numbers: dict[int, int], told: str) -> None:
    before = renumber(folder, numbers, 255 if numbers is ADE else 0)
    if text:
        (folder / "gt" / "classes.toml").write_text(text)
    (folder / "gt" / "semantic").rename(folder / "gt" / name)
    warnings = check(folder, before)
    assert [told in one for one in warnings] == [True] * bool(told)


def test_ground_truth_that_contradicts_its_table_is_refused(folder: Path) -> None:
    renumber(folder, NYU13)
    (folder / "gt" / "semantic").rename(folder / "gt" / "semantic_nyu40")
    refuses("other-numbers ground truth's nyu13:1-13 nyu40 Write", folder)


def semantic(scene: Scene, position: int = 1) -> np.ndarray:
    reader = scene.frames[position].read_ground_truth
    assert reader is not None
    truth = reader(None)
    assert truth is not None
    return truth.semantic


def test_ground_truth_is_read_at_any_size(folder: Path) -> None:
    reader = open_scene(folder).frames[1].read_ground_truth
    assert reader is not None
    own, small = reader(None), reader((16, 12))
    assert own is not None and small is not None
    assert own.semantic.dtype == own.instance.dtype == np.int32
    assert {*np.unique(own.instance).tolist()} == {0, 1, 2}
    assert (own.semantic[own.instance == 1] == 5).all() and (own.semantic[own.instance == 2] == 3).all()
    np.testing.assert_array_equal(small.semantic, own.semantic[1::2, 1::2])


def test_ground_truth_folders_of_panoptic_lifting_are_preferred(folder: Path) -> None:
    for index in range(3):
        for kind in ("semantics", "instance"):
            (folder / f"rs_{kind}").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / f"rs_{kind}" / f"{index:04d}.png"), np.full((24, 32), 2, np.uint8))
    assert (semantic(open_scene(folder)) == 2).all(), "floor is 2 in both tables"


def test_a_file_may_name_the_class_table_of_ground_truth(folder: Path) -> None:
    numbers = np.full(14, 255, np.uint8)
    numbers[[1, 2, 3, 5]] = 131, 122, 120, 56  # COCO's
    before = semantic(open_scene(folder))
    for path in (folder / "gt" / "semantic").glob("*.png"):
        cv2.imwrite(str(path), numbers[cv2.imread(str(path), cv2.IMREAD_UNCHANGED)])
    (folder / "gt" / "classes.toml").write_text('table = "coco"\nvoid = [56]\n')
    scene = open_scene(folder)
    np.testing.assert_array_equal(semantic(scene), np.where((before == 13) | (before == 5), 0, before))
    assert not any("ground truth" in warning for warning in check_scene(scene))
    (folder / "gt" / "classes.toml").write_text('table = "coco"\nto = "reduced"\n')
    np.testing.assert_array_equal(semantic(open_scene(folder)), np.where(before == 13, 0, before))


@pytest.mark.parametrize(
    ("truth", "masks", "expected"),
    [
        ("nyu40", "coco", {"sofa": "couch", "chair": "chair", "ceiling": "ceiling-merged", "wall": None}),
        ("coco", "reduced", {"couch": "sofa", "wall-brick": "wall", "vase": "otherprop", "car": None}),
        ("scannet200", "reduced", {"floor": "floor", "couch": "sofa", "tv": "television", "dumbbell": None}),
        ("cityscapes", "ade20k", {"road": "road", "sky": "sky", "rider": None}),
    ],
)
def test_ground_truth_is_matched_by_class_name(truth: str, masks: str, expected: dict[str, str | None]) -> None:
    classes = class_map(known_table(masks).labels, None, Path(), objects=False).classes
    names = {label.id: label.name for label in known_table(truth).labels}
    found = classes_by_name(names, classes)
    numbers = {name: number for number, name in names.items()}
    told = {name: classes[found[numbers[name]]].name if numbers[name] in found else None for name in expected}
    assert told == expected


def test_ground_truth_classes_are_matched_by_their_exact_names(folder: Path) -> None:
    wall = open_scene(folder).classes[1]
    classes = ClassTable((wall, replace(wall, id=2, name="Wall")))
    assert classes_by_name({8: "Wall", 9: "wall", 10: "WALL"}, classes) == {8: 2, 9: 1, 10: 1}


def test_frames_may_lack_ground_truth(folder: Path) -> None:
    (folder / "gt" / "instance" / "0001.png").unlink()
    scene = open_scene(folder)
    assert scene.frames[1].read_ground_truth is None and scene.frames[0].read_ground_truth is not None
    assert "1 of 3 frames have no ground truth in semantic" in scene.warnings
    shutil.rmtree(folder / "gt")
    scene = open_scene(folder)
    assert not any(frame.read_ground_truth for frame in scene.frames) and "ground truth" not in str(scene.warnings)


def test_views_can_be_read_without_ground_truth(folder: Path) -> None:
    before = [load_view(frame) for frame in open_scene(folder).frames]
    shutil.rmtree(folder / "gt")
    for one, frame in zip(before, open_scene(folder).frames, strict=True):
        other = load_view(frame)
        assert one.mask.segments == other.mask.segments
        for a, b in ((one.colour, other.colour), (one.depth, other.depth), (one.mask.ids, other.mask.ids)):
            np.testing.assert_array_equal(a, b)
