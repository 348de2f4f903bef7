"""The numbers of a ground truth: its own table's, the masks' class ids, or those that agree with the masks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.scene import Category, ClassTable, GroundTruth, describe, open_scene
from engine.scene.ground_truth import numbers_by_agreement
from tests.scene.refusing import refuses
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
    ("numbers", "void", "table", "without"),
    [
        (ADE, 255, "ade20k:0-149", ()),
        (ADE_DATA, 0, "ade20k:1-150", ()),
        (COCO_DATA, 0, "coco:90", ()),
        ({key: number - 1 for key, number in NYU40.items()}, 255, "nyu40:0-39", ()),
        (NYU13, 0, "nyu13:1-13", (3,)),
        (RAW, 0, "scannet:1-1357", ()),
    ],
)
def test_numbers_of_another_table_are_told_by_the_masks(
    folder: Path, numbers: dict[int, int], void: int, table: str, without: tuple[int, ...]
) -> None:
    (warning,) = check(folder, renumber(folder, numbers, void), without)
    is_doubted = "but look like" in warning
    assert f"look like {table}: " in warning if is_doubted else f"numbers are read as {table}: " in warning
    report = describe(open_scene(folder))
    assert [warning] == [str(each) for each in report.inferred if each.is_doubtful]


@pytest.mark.parametrize("is_asked", [True, False])
def test_what_may_be_two_tables_is_asked_for(is_asked: bool) -> None:
    """The number 10 is a bookshelf or a counter."""
    names = {101: "wall", 102: "floor", 104: "counter"}
    classes = ClassTable(tuple(Category(n, name, False, (n, 0, 0)) for n, name in names.items()))
    joint = {(1, 101): 1000, (2, 102): 800} | ({(10, 104): 20} if is_asked else {})
    if not is_asked:
        assert numbers_by_agreement(joint, classes, Path("gt")).looks_like == "nyu40:1-40"
        return
    told = 'look like nyu40:1-40, reduced: .*Write table = "nyu40:1-40" or table = "reduced" into'
    with pytest.raises(PlgsError, match=told):
        numbers_by_agreement(joint, classes, Path("gt"))


def test_a_truth_that_no_table_explains_is_told(folder: Path) -> None:
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
def test_the_numbering_of_a_named_table_is_told(
    folder: Path, text: str, name: str, numbers: dict[int, int], told: str
) -> None:
    before = renumber(folder, numbers, 255 if numbers is ADE else 0)
    if text:
        (folder / "gt" / "classes.toml").write_text(text)
    (folder / "gt" / "semantic").rename(folder / "gt" / name)
    warnings = check(folder, before)
    assert [told in one for one in warnings] == [True] * bool(told)


def test_a_truth_of_another_table_than_its_folder_says_is_refused(folder: Path) -> None:
    renumber(folder, NYU13)
    (folder / "gt" / "semantic").rename(folder / "gt" / "semantic_nyu40")
    refuses('ground truth\'s numbers look like nyu13:1-13, not nyu40: .*Write table = "nyu13:1-13" or', folder)
