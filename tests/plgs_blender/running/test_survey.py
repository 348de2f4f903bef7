"""A scene's survey says what is wrong, whatever the folder is called."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.running import survey
from plgs.plgs_blender.tasks import registry


@pytest.fixture(autouse=True)
def no_inspector() -> Iterator[None]:
    yield
    registry.forget_all()


@pytest.mark.parametrize("name", ["a" * 300, "a\0b", "a\ud800b"], ids=["long", "null", "surrogate"])
def test_paths_that_cannot_be(tmp_path: Path, name: str) -> None:
    for chosen in (ChosenScene(tmp_path / name, None, "z"), ChosenScene(tmp_path, tmp_path / name, "z")):
        seen = survey.look(chosen, None)
        assert seen.error is not None and seen.error.fix and not seen.is_looking
    if name.isascii() and "\0" in name:  # no program can be told it
        assert survey.look(ChosenScene(tmp_path / name, None, "z"), Path(sys.executable)).error
