"""ScanNet's export and Panoptic Lifting's prepared folders, and the question of check_on_room itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from engine.scene import Frame, Scene, open_scene
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


def shifted(frame: Frame) -> Frame:
    return dataclasses.replace(
        frame, camera=dataclasses.replace(frame.camera, cx=frame.camera.cx + 0.5, cy=frame.camera.cy + 0.5)
    )


def inverted(frame: Frame) -> Frame:
    inverse = np.linalg.inv(frame.camera.camera_to_world)
    return dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, camera_to_world=inverse))


def upside_down(frame: Frame) -> Frame:
    pose = frame.camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
    return dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, camera_to_world=pose))


def along_the_ray(frame: Frame) -> Frame:
    camera = frame.camera
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    length = np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2).astype(np.float32)
    return dataclasses.replace(frame, read_depth=lambda size: frame.depth(size) * length)


def in_other_units(frame: Frame) -> Frame:
    return dataclasses.replace(frame, read_depth=lambda size: frame.depth(size) * np.float32(1.024))


@pytest.mark.parametrize("spoil", [shifted, inverted, upside_down, along_the_ray, in_other_units])
def test_the_room_notices(scene: Scene, spoil: object) -> None:
    assert callable(spoil)
    with pytest.raises(AssertionError):
        check_on_room(dataclasses.replace(scene, frames=tuple(spoil(frame) for frame in scene.frames)))
