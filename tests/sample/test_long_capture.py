"""A long capture made of the sample: a scene that can be lifted, laps aside of each other, masks as a network's."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from engine.scene import check_scene, load_view, open_scene

FRAMES = 3


@pytest.fixture(scope="module")
def long_capture() -> ModuleType:
    """The program, imported late: open3d is large."""
    pytest.importorskip("open3d")
    return importlib.import_module("long_capture")


@pytest.fixture(scope="module")
def capture(long_capture: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames that stand where frames of the sample stood. Three of its 72 frames are fused for them."""
    poses, intrinsic = long_capture.room_cameras()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(long_capture, "room_cameras", lambda: (poses[:FRAMES], intrinsic))
        patch.setattr(long_capture, "HELD_OUT", 1)
        out = tmp_path_factory.mktemp("long") / "capture"
        long_capture.write_long_capture(out, FRAMES, 0)
    return out


def test_it_can_be_lifted(capture: Path) -> None:
    scene = open_scene(capture)
    assert [frame.size for frame in scene.frames] == [(1296, 968)] * FRAMES and len(scene.test_frames) == 1
    assert scene.has_depth and scene.has_masks
    check_scene(scene)
    view = load_view(scene.frames[1], (162, 121))
    assert (view.depth > 0).mean() > 0.6 and 0.5 < np.median(view.depth[view.depth > 0]) < 9.0
    assert len(np.unique(view.mask.ids)) > 5


def test_truth_and_masks_show_the_same_room(capture: Path) -> None:
    frame = open_scene(capture).frames[0]
    assert frame.read_ground_truth is not None
    truth, mask = frame.read_ground_truth((324, 242)), frame.mask((324, 242))
    known = (truth.semantic > 0) & (mask.ids > 0)
    assert known.mean() > 0.4 and (truth.semantic == mask.class_map())[known].mean() > 0.4


def test_laps_go_there_and_back_side_by_side(long_capture: ModuleType) -> None:
    poses, _ = long_capture.room_cameras()
    walked = long_capture.laps(poses, 2 * long_capture.LAP + 10, 0)
    assert len(walked) == 2 * long_capture.LAP + 10
    centres = np.array([pose[:3, 3] for pose in walked])
    there, back = centres[: long_capture.LAP], centres[long_capture.LAP : 2 * long_capture.LAP][::-1]
    apart = np.linalg.norm(there - back, axis=1)
    assert (
        0.02 < np.median(apart) < 6 * long_capture.ASIDE and np.linalg.norm(np.diff(there, axis=0), axis=1).max() < 0.5
    )
    rotations = np.array([pose[:3, :3] for pose in walked])
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1) - np.eye(3), 0.0, atol=1e-9)


def test_frames_held_out_are_spread_evenly(long_capture: ModuleType) -> None:
    numbers = long_capture.held_out(1000)
    assert len(numbers) == long_capture.HELD_OUT
    gaps = np.diff(numbers)
    assert gaps.min() > 0.9 * gaps.max()
