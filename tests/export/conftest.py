"""A small lift to export."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from engine.command_line.main import main
from engine.export.source import FinishedLift
from engine.job import LiftFolder, LiftRequest
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiftFolder]:
    """Six frames, of which the held-out one is baked."""
    root = tmp_path_factory.mktemp("export")
    scene = write_tiny_scene(root / "scene", frames=6, noise=0.1)
    with presets_as(preview=TINY):
        yield lift_into(root / "lift", LiftRequest(scene=scene, bake="test"))


@pytest.fixture(scope="module")
def truth(lift: LiftFolder) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Class and instance ids of every frame, as the lift shows them."""
    return {f.name: (layers.semantic, layers.instance) for f, layers in FinishedLift(lift, ["all"]).views()}


def run(lift: LiftFolder, kind: str, output: Path, *more: str) -> None:
    assert main(["export", str(lift.path), "--to", kind, "-o", str(output), *more]) == 0
