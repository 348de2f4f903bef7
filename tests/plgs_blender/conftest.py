"""Every test here begins with an empty file, and leaves one."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest
import tiny_lift
from plgs.plgs_blender import registry


@pytest.fixture(autouse=True)
def empty_file() -> Iterator[None]:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    yield
    registry.forget_all()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture(scope="session")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished lift of the tiny room with tiny_lift.FRAMES frames, two of them held out. Only for reading."""
    return tiny_lift.write_tiny_lift(tmp_path_factory.mktemp("lifts") / "lift").path
