from __future__ import annotations

from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.posed.layout import file_inside, files_by_stem, listed, natural_order, same_shape
from engine.scene.files_of_frames import of_same_number


def test_frames_come_in_natural_order() -> None:
    names = ["10", "9", "0_0010", "0_0009", "frame2", "frame10", "frame-000001.color"]
    assert sorted(names, key=natural_order) == [
        "0_0009",
        "0_0010",
        "9",
        "10",
        "frame2",
        "frame10",
        "frame-000001.color",
    ]


def test_files_are_found_by_stem_whatever_the_case_of_their_suffix(tmp_path: Path) -> None:
    for name in ("10.JPG", "9.png", "._9.png", ".DS_Store", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "8.png").mkdir()
    assert list(files_by_stem(tmp_path, {".jpg", ".png"}, "Fix.")) == ["9", "10"]


@pytest.mark.parametrize(
    ("names", "stems", "found"),
    [
        (["rgb_1", "rgb_10"], ["sem_10", "sem_1", "vis_sem_1"], ["sem_1", "sem_10"]),
        (["a1_rgb_2"], ["a2_mask_2", "a_1_mask_02"], ["a_1_mask_02"]),
        (["rgb_1"], ["semantic_1", "instance_1"], []),  # which of the two?
        (["rgb_1"], ["depth_1", "semantic_1_color", "other_semantic_1", "semantic"], []),
        (["1", "01"], ["semantic_1"], ["semantic_1"]),  # two frames have this number: files stay as they are
        (["rgb_1", "rgb_2"], ["rgb_2", "semantic_1"], ["rgb_2", "semantic_1"]),  # and where a name is a frame's
        (["rgb"], ["semantic"], []),
    ],
)
def test_files_of_a_frames_number(names: list[str], stems: list[str], found: list[str]) -> None:
    files = of_same_number(names, {stem: Path(stem) for stem in stems})
    assert [path.name for path in files.values()] == found


def test_same_shape_forgives_scannet_and_nothing_else() -> None:
    assert same_shape((1296, 968), (640, 480))
    assert not same_shape((640, 480), (640, 360))
    assert not same_shape((640, 480), (480, 640))


def test_long_lists_and_strange_names_stay_on_one_line() -> None:
    assert listed(range(7)) == "0, 1, 2, 3, 4 and 2 more"
    assert listed(["a\nb\x1b[31m"]) == "a?b?[31m"


@pytest.mark.parametrize(
    "name", ["../a.png", "a/../../b.png", "/a.png", "\\a.png", "C:a.png", "\\\\host\\a.png", "a\0.png", "", "."]
)
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(PlgsError, match="leaves the folder"):
        file_inside(tmp_path, name, tmp_path / "table.json")


@pytest.mark.parametrize("name", ["a.png", "sub/a.png", "..a.png"])
def test_plain_names_are_accepted(tmp_path: Path, name: str) -> None:
    assert file_inside(tmp_path, name, tmp_path / "table.json") == tmp_path / name
