"""Operators are called as scripts call them: in Blender without a window, with the extension switched on."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import pytest

for folder in (Path(__file__).parents[1] / "plgs_blender", Path(__file__).parents[1]):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

import tiny_lift  # noqa: E402  (beside the tests of plgs_blender)
from tiny_scene import write_tiny_scene  # noqa: E402

from tests.scene.formats.test_colmap import write_text  # noqa: E402
from tests.scene.formats.test_nerfstudio import write_scene  # noqa: E402
from tests.scene.formats.test_scannet import sens  # noqa: E402


@pytest.fixture(autouse=True)
def extension(plgs: ModuleType) -> Iterator[None]:
    """On before each test and off afterwards, in an empty file."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    plgs.register()
    yield
    plgs.unregister()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of 8 small frames. Only for reading."""
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny room", frames=8, size=(64, 48))


@pytest.fixture(scope="session")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished lift. Only for reading."""
    return tiny_lift.write_tiny_lift(tmp_path_factory.mktemp("lifts") / "lift").path


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with captures in other layouts: COLMAP in walk, transforms.json in studio, two .sens in scans. Only for
    reading, but engines put what they make of them beside them.
    """
    folder = tmp_path_factory.mktemp("captures")
    write_text(folder / "walk")
    write_scene(folder / "studio")
    (folder / "scans").mkdir()
    for name in ("one", "two"):
        (folder / "scans" / f"{name}.sens").write_bytes(sens())
    return folder
