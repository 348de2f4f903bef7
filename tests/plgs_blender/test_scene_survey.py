"""A scene's survey says what is wrong, whatever the folder is called."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from plgs.plgs_blender import scene_survey
from plgs.plgs_blender.scene_survey import Place


@pytest.fixture(autouse=True)
def no_inspector() -> Iterator[None]:
    yield
    scene_survey.stop_looking()


@pytest.mark.parametrize("name", ["a" * 300, "a\0b", "a\ud800b"], ids=["long", "null", "surrogate"])
def test_paths_that_cannot_be(tmp_path: Path, name: str) -> None:
    for place in (Place(tmp_path / name, None, "z"), Place(tmp_path, tmp_path / name, "z")):
        survey = scene_survey.look(place, None)
        assert survey.error and survey.fix and not survey.is_looking
    if name.isascii() and "\0" in name:  # no program can be told it
        assert scene_survey.look(Place(tmp_path / name, None, "z"), Path(sys.executable)).error
