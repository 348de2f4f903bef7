"""ScanNet's export and Panoptic Lifting's prepared folders, and the question of check_on_room itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engine.scene import Scene, open_scene
from tests.scene.formats.room import Lens, check_on_room, look, opencv_pose, views
from tests.scene.formats.writing import write_pair


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """As ScanNet's SensReader exports, with Panoptic Lifting's names of frames; K has integer pixel centres."""
    lens = Lens()
    for i, view in enumerate(views()):
        write_pair(tmp_path / "color" / f"0_{i:04d}.png", tmp_path / "depth" / f"0_{i:04d}.png", look(view, lens))
        (tmp_path / "pose").mkdir(exist_ok=True)
        np.savetxt(tmp_path / "pose" / f"0_{i:04d}.txt", opencv_pose(view), "%.6f")
    K = [[lens.fx, 0, lens.cx - 0.5, 0], [0, lens.fy, lens.cy - 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (tmp_path / "intrinsic").mkdir()
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", K, "%.6f")
    return open_scene(tmp_path)


def test_points_lie_on_the_room(scene: Scene) -> None:
    assert scene.format == "scannet" and scene.frames[0].name == "0_0000"
    check_on_room(scene)
