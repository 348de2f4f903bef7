"""A file of a scene or of a lift, dropped on the 3D view by a file manager, opens what it is part of."""

from __future__ import annotations

from pathlib import Path

import pytest
from blender import SIZE, Window
from tiny_scene import write_tiny_scene

from engine.job import LiftFolder, LiftRequest

IN_THE_VIEW = SIZE[0] // 2 - 100, SIZE[1] // 2


@pytest.fixture(scope="module")
def scene(work_folder: Path) -> Path:
    """Under a name that has to be encoded on its way from the file manager."""
    return write_tiny_scene(work_folder / "dropped" / "my 100% räum", frames=2)


def folders(window: Window) -> list[str]:
    """The panel's scene folder and its lift folder."""
    chosen: list[str] = window.ask("bpy.context.scene.plgs.scene_folder, bpy.context.scene.plgs.lift_folder")
    return chosen


@pytest.mark.parametrize(
    "names", [["panoptic.json"], pytest.param(["pose/0000.txt", "pose/0001.txt"], marks=pytest.mark.slow)]
)
def test_files_of_a_scene(window: Window, scene: Path, names: list[str]) -> None:
    window.drop(*IN_THE_VIEW, *(scene / name for name in names))
    assert folders(window) == [str(scene), ""]


def test_a_file_of_a_lift(window: Window, scene: Path) -> None:
    lift = LiftFolder.create(scene.parent / "my lift", LiftRequest(scene=scene))
    window.drop(*IN_THE_VIEW, lift.path / "request.json")
    assert folders(window) == ["", str(lift.path)]


def test_blender_never_asks_extensions_about_a_folder(window: Window, scene: Path) -> None:
    """By its rule that a handler is found by the ending of a name. Were that to change, README.md could say so."""
    window.drop(*IN_THE_VIEW, scene)
    assert folders(window) == ["", ""]
