"""No engine that only Blender waits for outlives it."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
from plgs.plgs_blender import scene_diagnosis, scene_survey
from plgs.plgs_blender.running import exports, frame_making, mask_making
from plgs.plgs_blender.running.frame_making import Order
from plgs.plgs_blender.scene_survey import Place

PYTHON = Path(sys.executable)
asked: list[list[str | Path]] = []


class Pretended:
    """An engine that has ended."""

    def __init__(self, command: list[str | Path]) -> None:
        asked.append(command)

    def exit_code(self) -> int:
        return 0

    def output_tail(self) -> str:
        return ""

    def kill(self) -> None: ...
    def close(self) -> None: ...


@pytest.fixture(autouse=True)
def engines(monkeypatch: pytest.MonkeyPatch) -> None:
    asked.clear()
    for module in (scene_survey, scene_diagnosis, exports, frame_making, mask_making):
        assert isinstance(module, ModuleType)
        monkeypatch.setattr(module, "EngineProcess", Pretended)


def test_engines_are_told_to_stay_with_blender(tmp_path: Path) -> None:
    place = Place(tmp_path / "room")
    scene_survey.look(place, PYTHON)
    scene_survey.stop_looking()
    scene_diagnosis.begin(place, PYTHON)
    scene_diagnosis.forget()
    mask_making.begin(place, PYTHON, "", download=False)
    mask_making.stop()
    frame_making.begin(Order(place, "", ("cloud",)), PYTHON)
    frame_making.forget()
    exports.start(tmp_path / "lift", "coco", tmp_path / "out", PYTHON)
    exports.let_go()
    commands = [command[command.index(PYTHON) + 4] for command in asked]
    assert commands == ["inspect", "inspect", "segment", "frames", "export"]
    assert all("--stay-with-parent" in command for command in asked)
