"""Operators are called as scripts call them: in Blender without a window, with the extension switched on."""

import shutil
from pathlib import Path

import bpy
import pytest
import tiny_lift
from plgs.plgs_blender.lift_scene import place_lift
from tiny_scene import write_tiny_scene

from tests.scene.formats.test_colmap import write_text
from tests.scene.formats.test_nerfstudio import write_scene
from tests.scene.formats.test_scannet import sens


@pytest.fixture(autouse=True)
def _switched_on(extension: None) -> None:
    """In an empty file."""


@pytest.fixture(autouse=True)
def _engines_are_forks(engines_are_forks: None) -> None:
    """Of every test."""


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of 8 small frames. Only for reading."""
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny room", frames=8, size=(64, 48))


@pytest.fixture(scope="session")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished lift. Only for reading."""
    return tiny_lift.write_tiny_lift(tmp_path_factory.mktemp("lifts") / "lift").path


@pytest.fixture
def mine(lift: Path, tmp_path: Path) -> Path:
    """A lift to change."""
    return Path(shutil.copytree(lift, tmp_path / "mine"))


@pytest.fixture
def placed(mine: Path) -> bpy.types.Collection:
    """Its collection in the open scene."""
    collection = place_lift(mine, bpy.context.scene)
    bpy.context.view_layer.update()
    return collection


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Captures in other layouts: COLMAP in walk, transforms.json in studio, two .sens in scans. Engines write beside
    them."""
    folder = tmp_path_factory.mktemp("captures")
    write_text(folder / "walk")
    write_scene(folder / "studio")
    (folder / "scans").mkdir()
    for name in ("one", "two"):
        (folder / "scans" / f"{name}.sens").write_bytes(sens())
    return folder
