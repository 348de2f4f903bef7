"""Terminals in an empty clone, and in one with a finished lift of the tiny room as `lifts/demo`."""

import shutil
from pathlib import Path

import pytest

from engine.job import LiftRequest
from tests.doors.terminal import Terminal
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as


@pytest.fixture(autouse=True)
def _engines_are_forks(engines_are_forks: None) -> None:
    """Of every test."""


@pytest.fixture(scope="session")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the tiny room `scans/room` and its lift `lifts/demo`, with its held-out frame baked."""
    root = tmp_path_factory.mktemp("doors")
    scene = write_tiny_scene(root / "scans" / "room", frames=6, noise=0.1)
    with presets_as(preview=TINY):
        lift_into(root / "lifts" / "demo", LiftRequest(scene=scene, bake="test"))
    return root


@pytest.fixture
def terminal(lifted: Path, tmp_path: Path, quick_python: Path) -> Terminal:
    """With files of its own, which a test may change."""
    folder = tmp_path / "clone"
    shutil.copytree(lifted, folder)
    return Terminal.like_a_clone(folder, quick_python)


@pytest.fixture
def shell(tmp_path: Path, quick_python: Path) -> Terminal:
    """In an empty clone."""
    (tmp_path / "clone").mkdir()
    return Terminal.like_a_clone(tmp_path / "clone", quick_python)
