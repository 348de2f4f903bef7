"""The red kitchen's program, on a made-up folder with the names of tsdf-fusion-python's."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.sample.conftest import Make, Refused
from tests.tiny_scene import tiny_pose, trace_view

PROGRAM = "red_kitchen.py"
SIZE = (640, 480)
FRAMES = 5
DEPTH_LENS = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])
HALF = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Added to a lens with pixel centres at whole numbers for `trace_view`, which has them at +0.5."""


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Only for reading."""
    folder = tmp_path_factory.mktemp("data")
    np.savetxt(folder / "camera-intrinsics.txt", DEPTH_LENS)
    for index in range(FRAMES):
        pose = tiny_pose(index, FRAMES)
        view = trace_view(pose, DEPTH_LENS + HALF, SIZE)
        depth = np.round(view.depth * 1000).astype(np.uint16)
        depth[:60], depth[60:120] = 65535, 0
        cv2.imwrite(str(folder / f"frame-{index:06d}.color.jpg"), view.colour)
        cv2.imwrite(str(folder / f"frame-{index:06d}.depth.png"), depth)
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", pose)
    return folder


@pytest.fixture
def data(frames: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(frames, tmp_path / "data"))


def test_it_makes_a_scene_that_can_be_lifted(data: Path, tmp_path: Path, make: Make) -> None:
    said = make(data, tmp_path / "kitchen", "--every", "2")
    assert said.returncode == 0 and "3 frames" in said.stdout, said.stderr
    scene = open_scene(tmp_path / "kitchen", None, "z")
    assert [frame.name for frame in scene.frames] == ["000000", "000002", "000004"]
    frame = scene.frames[1]
    assert (frame.read_mask(None).class_map() == 1).all()
    photo = data / "frame-000002.color.jpg"
    assert (tmp_path / "kitchen/color/000002.jpg").read_bytes() == photo.read_bytes()


def test_depth_is_what_the_colour_camera_sees(data: Path, tmp_path: Path, make: Make) -> None:
    assert make(data, tmp_path / "kitchen", "--every", "2").returncode == 0
    frame = open_scene(tmp_path / "kitchen", None, "z").frames[1]
    pose = tiny_pose(2, FRAMES)
    np.testing.assert_allclose(frame.camera.centre, pose[:3, 3] + 0.025 * pose[:3, 0])
    np.testing.assert_allclose(frame.camera.camera_to_world[:3, :3], pose[:3, :3])
    depth, true = frame.read_depth(None), trace_view(frame.camera.camera_to_world, frame.camera.K, SIZE).depth
    assert not depth[:100].any(), "there the depth camera measured nothing"
    assert (depth[160:420, 60:580] > 0).mean() > 0.99
    errors = np.abs(depth - true)[depth > 0]
    assert np.quantile(errors, 0.95) < 0.01, "but for the outlines of furniture"


def test_bad_input_is_one_line(data: Path, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "empty").mkdir()

    refused("no frames", tmp_path / "empty", tmp_path / "out")
    refused("already", data, data)
    (data / "frame-000000.pose.txt").write_text("1 2\n3 4\n")
    refused("frame-000000.pose.txt", data, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    cv2.imwrite(str(data / "frame-000000.depth.png"), np.zeros((480, 640), np.uint8))
    refused("frame-000000.depth.png", data, tmp_path / "out")
    (data / "camera-intrinsics.txt").unlink()
    refused("camera-intrinsics.txt", data, tmp_path / "out")
