"""Every test here begins with an empty file, and leaves one."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest

for folder in (Path(__file__).parent, Path(__file__).parent.parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

import tiny_lift  # noqa: E402  (beside this file)


@pytest.fixture(autouse=True)
def empty_file() -> Iterator[None]:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    yield
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture(scope="session")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished lift of the tiny room with tiny_lift.FRAMES frames, two of them held out. Only for
    reading.
    """
    return tiny_lift.write_tiny_lift(tmp_path_factory.mktemp("lifts") / "lift").path
