"""A scene's survey says what is wrong, whatever the folder is called."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
from plgs.plgs_blender import registry
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.running import survey

from engine.scene import counted, describe, open_scene
from tests.tiny_scene import write_tiny_scene


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


def test_the_panel_has_what_the_engine_inferred_and_left_out(tmp_path: Path) -> None:
    broken = sorted((write_tiny_scene(tmp_path, frames=5) / "depth").iterdir())[1]
    broken.write_bytes(broken.read_bytes()[:-30] + bytes(30))
    report = describe(open_scene(tmp_path))
    answer = {**asdict(report), "left_out": counted(report.left_out)}
    found = survey._with_answer(survey.Survey(ChosenScene(tmp_path, None, "z")), answer, None)
    assert found.error is None and found.left_out == 1
    assert [text.split(":")[0] for text, doubtful in found.inferred if not doubtful] == ["Format", "Split"]
