"""Replica's renderings as NICE-SLAM has them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from engine.scene import open_scene
from tests.scene.formats.room import Lens, check_on_room, look, opencv_pose, views, write_pair

# 600 600 599.5 339.5 of 1200x680, integer centres, for a tenth of the size; and another lens that sees 90 degrees.
NICE = Lens(120, 68, 60.0, 60.0, 60.0, 34.0)
HALF = Lens(64, 48, 32.0, 32.0, 32.0, 24.0)


def write_nice(folder: Path, lens: Lens = NICE, steps: float = 6553.5) -> Path:
    for i, view in enumerate(views()):
        results = folder / "results"
        write_pair(results / f"frame{i:06d}.jpg", results / f"depth{i:06d}.png", look(view, lens), steps)
    np.savetxt(folder / "traj.txt", [opencv_pose(view).ravel() for view in views()], "%.9e")
    return folder


def test_nice_slams_layout_is_read(tmp_path: Path) -> None:
    scene = open_scene(write_nice(tmp_path))
    assert scene.format == "replica" and scene.frames[0].name == "frame000000"
    check_on_room(scene, colour_step=60)


def test_nice_slams_camera_file(tmp_path: Path) -> None:
    lens = Lens()
    write_nice(tmp_path / "office0", lens, steps=1000.0)
    camera = {"w": 64, "h": 48, "fx": lens.fx, "fy": lens.fy, "cx": lens.cx - 0.5, "cy": lens.cy - 0.5, "scale": 1000.0}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    check_on_room(open_scene(tmp_path / "office0"), colour_step=60)
