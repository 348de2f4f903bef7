"""Formats are told apart by the names of their files; what is not clear is refused with a line."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.scene import FORMATS, open_scene
from tests.scene.formats import test_colmap, test_nerfstudio
from tests.scene.formats.room import check_colours
from tests.scene.refusing import refuses


def test_each_format_has_a_name_of_its_own_and_says_what_it_looks_for() -> None:
    names = [each.name for each in FORMATS]
    assert len({*names}) == len(names) == 17 and names[0] == "scannet"
    assert all(each.looks_for for each in FORMATS)


def test_two_formats_in_one_folder_have_to_be_told_apart(tmp_path: Path) -> None:
    test_colmap.write_text(test_nerfstudio.write_scene(tmp_path))
    refuses("this looks like nerfstudio and colmap.*--format nerfstudio", tmp_path)
    for name in ("nerfstudio", "colmap"):
        scene = open_scene(tmp_path, scene_format=name)
        assert scene.format == name
        check_colours(scene)


@pytest.mark.parametrize("name", [each.name for each in FORMATS])
@pytest.mark.parametrize("place", ["empty", "file.txt"])
def test_a_format_that_is_named_but_not_there_gets_a_line(tmp_path: Path, name: str, place: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").write_text("1 2 3\n")
    with pytest.raises(PlgsError) as caught:
        open_scene(tmp_path / place, scene_format=name)
    assert "\n" not in str(caught.value) and caught.value.fix
