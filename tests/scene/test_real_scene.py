"""The augmented ICL-NUIM living room with a real detector's masks: set PLGS_ICL to its folder to run this."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from engine.scene import Scene, check_scene, open_scene

FOLDER = os.environ.get("PLGS_ICL")

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not FOLDER, reason="PLGS_ICL names no folder")]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return open_scene(Path(str(FOLDER)), up="y")


def test_it_opens_without_a_warning(scene: Scene) -> None:
    assert (len(scene.train_frames), len(scene.test_frames), len(scene.classes)) == (71, 10, 40)
    assert check_scene(scene) == ()


def test_its_split_is_our_default_one(scene: Scene) -> None:
    assert [index for index, frame in enumerate(scene.frames) if frame.held_out] == list(range(4, 81, 8))


@pytest.mark.parametrize("gap", [1, 4])
def test_its_frames_agree_to_the_millimetre(scene: Scene, gap: int) -> None:
    medians = []
    for one, other in zip(scene.frames[::5], scene.frames[gap::5], strict=False):
        depth, seen = one.read_depth(None), other.read_depth(None)
        pixels, z = other.camera.project(one.camera.unproject(depth))
        columns, rows = np.floor(pixels).astype(int).transpose(2, 0, 1)
        inside = (depth > 0) & (z > 0.1) & (columns >= 0) & (columns < 640) & (rows >= 0) & (rows < 480)
        expected, found = z[inside], seen[rows[inside], columns[inside]]
        medians.append(float(np.median(np.abs(found - expected)[found > 0])))
    assert np.median(medians) < 0.0015
