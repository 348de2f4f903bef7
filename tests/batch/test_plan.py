"""Whatever scenes are called, a batch writes nowhere but into its own folders."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.batch.plan import names_of
from engine.errors import PlgsError


@pytest.mark.parametrize("name", ["...zip", "..zip", ".batch.zip", "table.md.zip", "Table.CSV.zip"])
def test_a_name_of_no_folder_of_its_own_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).touch()
    with pytest.raises(PlgsError, match=r"Rename the scene\.$"):
        names_of([tmp_path / name])


@pytest.mark.parametrize("other", ["y/room", "y/Room", "y/ROOM.zip"])
def test_two_scenes_of_one_name(other: str, tmp_path: Path) -> None:
    for scene in (tmp_path / "x" / "room", tmp_path / other):
        scene.mkdir(parents=True) if not scene.suffix else (scene.parent.mkdir(), scene.touch())
    with pytest.raises(PlgsError, match="two scenes"):
        names_of([tmp_path / "x" / "room", tmp_path / other])


def test_a_folder_is_named_by_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "a" / "-o").mkdir(parents=True)
    assert names_of([tmp_path / "a" / "-o" / ".." / "-o", tmp_path / "a" / "-o" / ".."]) == ["-o", "a"]
