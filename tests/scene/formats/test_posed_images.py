"""ScanNet's posed_images, written as mmdetection3d's export does, and with depth as others add it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engine.scene import open_scene
from tests.scene.formats.room import Lens, check_on_room, look, opencv_pose, views
from tests.scene.formats.writing import in_steps, write_colour, write_grey


def write_posed_images(folder: Path, *, depth: bool = True) -> Path:
    lens, matrix = Lens(), np.eye(4)
    matrix[:2, :3] = [[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5]]
    for i, view in enumerate(views()):
        picture = look(view, lens)
        write_colour(folder / f"{i:05d}.jpg", picture.colour)
        np.savetxt(folder / f"{i:05d}.txt", opencv_pose(view), "%f")
        if depth:
            write_grey(folder / f"{i:05d}.png", in_steps(picture.depth, 1000))
    np.savetxt(folder / "intrinsic.txt", matrix, "%f")
    return folder


def test_posed_images_with_depth_are_read(tmp_path: Path) -> None:
    scene = open_scene(write_posed_images(tmp_path))
    assert scene.format == "posed-images" and scene.frames[0].name == "00000"
    check_on_room(scene, colour_step=60)


def test_without_depth(tmp_path: Path) -> None:
    scene = open_scene(write_posed_images(tmp_path, depth=False))
    assert len(scene.frames) == len(views()) and not scene.has_depth


def test_frames_with_lost_tracking_are_left_out(tmp_path: Path) -> None:
    (write_posed_images(tmp_path) / "00002.txt").write_text("-inf -inf -inf -inf\n" * 4)
    scene = open_scene(tmp_path)
    assert [frame.name for frame in scene.frames][2] == "00003"
    assert "without a pose is left out: 00002" in scene.warnings[0]
