"""ScanNet's folders and its .sens."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import Scene, open_scene
from tests.scene.formats import room
from tests.scene.refusing import refuses

BESIDE = np.eye(4)
BESIDE[:3, 3] = 0.06, 0.01, -0.004
"""From points of a depth camera to points of the colour camera."""


def moved(view: room.View) -> room.View:
    """The view of that depth camera."""
    pose = room.opencv_pose(view) @ BESIDE
    return room.View(pose[:3, 3], view.right, view.up, view.forward)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """As ScanNet's SensReader exports, with Panoptic Lifting's names of frames; K has integer pixel centres."""
    lens = room.Lens()
    for i, view in enumerate(room.views()):
        room.write_pair(
            tmp_path / "color" / f"0_{i:04d}.png", tmp_path / "depth" / f"0_{i:04d}.png", room.look(view, lens)
        )
        (tmp_path / "pose").mkdir(exist_ok=True)
        np.savetxt(tmp_path / "pose" / f"0_{i:04d}.txt", room.opencv_pose(view), "%.6f")
    K = [[lens.fx, 0, lens.cx - 0.5, 0], [0, lens.fy, lens.cy - 0.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (tmp_path / "intrinsic").mkdir()
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", K, "%.6f")
    return open_scene(tmp_path)


def test_points_of_a_scannet_folder_lie_on_the_walls(scene: Scene) -> None:
    assert scene.format == "scannet" and scene.frames[0].name == "0_0000"
    room.check_on_room(scene)


def test_scannets_depth_camera_extrinsic_is_applied(scene: Scene) -> None:
    for i, view in enumerate(room.views()):
        room.write_grey(
            scene.folder / "depth" / f"0_{i:04d}.png", room.in_steps(room.look(moved(view), room.Lens()).depth, 1000)
        )
    path = scene.folder / "intrinsic" / "extrinsic_depth.txt"
    off = np.concatenate([(frame.depth(None) - room.look(view, room.Lens()).depth).ravel() for frame, view in zip(
        open_scene(scene.folder).frames, room.views(), strict=True)])  # fmt: skip
    assert (np.abs(off) > 0.05).mean() > 0.1
    np.savetxt(path, BESIDE)
    room.check_on_room(open_scene(scene.folder), tolerance=0.06, share=0.97)
    for wrong in (BESIDE * 1000, np.zeros((4, 4))):
        np.savetxt(path, wrong)
        assert any("extrinsics are ignored" in warning for warning in open_scene(scene.folder).warnings)


COLOUR = room.Lens(108, 80, 97.0, 97.5, 54.3, 40.2)
DEPTH = room.Lens(64, 48, 58.0, 58.4, 32.4, 24.1)


def four(lens: room.Lens) -> np.ndarray:
    """The 4x4 of a lens with integer pixel centres."""
    K = np.eye(4, dtype=np.float32)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5
    return K


def sens(compressed: bool = True, lost: int | None = None, beside: np.ndarray | None = None) -> bytes:
    name = b"StructureSensor"
    data = struct.pack("<I", 4) + struct.pack("<Q", len(name)) + name
    for matrix in (four(COLOUR), np.eye(4), four(DEPTH), np.eye(4) if beside is None else beside):
        data += struct.pack("<16f", *matrix.ravel())
    data += struct.pack("<ii", 1, 1 if compressed else 0)
    data += struct.pack("<IIIIf", COLOUR.width, COLOUR.height, DEPTH.width, DEPTH.height, 1000.0)
    data += struct.pack("<Q", 6 + (lost is not None))
    for i, view in enumerate(room.views()):
        if i == lost:
            data += struct.pack("<16f", *[-np.inf] * 16) + struct.pack("<QQQQ", 0, 0, 0, 0)
        colour = cv2.imencode(".png", room.look(view, COLOUR).colour[..., ::-1])[1].tobytes()
        depth = np.round(room.look(view if beside is None else moved(view), DEPTH).depth * 1000).astype("<u2").tobytes()
        depth = zlib.compress(depth) if compressed else depth
        data += struct.pack("<16f", *room.opencv_pose(view).ravel())
        data += struct.pack("<QQQQ", 33 * i, 33 * i, len(colour), len(depth)) + colour + depth
    return data + struct.pack("<Q", 0)


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("place", ["", "scene0000_00.sens"])
def test_points_of_a_scannet_sens_lie_on_the_walls(tmp_path: Path, compressed: bool, place: str) -> None:
    (tmp_path / "scene0000_00.sens").write_bytes(sens(compressed, lost=2))
    scene = open_scene(tmp_path / place)
    assert scene.format == "sens" and [frame.name for frame in scene.frames] == ["0", "1", "3", "4", "5", "6"]
    assert "1 frame without a pose is left out: 2" in scene.warnings
    # Depth is of another lens: its pixels lie up to 0.7 pixels aside of those that they are read for.
    room.check_on_room(scene, tolerance=0.06, share=0.97)
    depth = [frame.depth((COLOUR.width, COLOUR.height)) for frame in scene.frames]
    truth = [room.look(view, COLOUR).depth for view in room.views()]
    off = np.concatenate([(one - other)[one > 0] for one, other in zip(depth, truth, strict=True)])
    assert abs(np.median(off)) < 0.001 and np.median(np.abs(off)) < 0.008


def test_scannet_depth_of_a_second_camera_is_registered_to_colour(tmp_path: Path) -> None:
    (tmp_path / "a.sens").write_bytes(sens(beside=BESIDE))
    scene = open_scene(tmp_path)
    assert scene.warnings == ()
    room.check_on_room(scene, tolerance=0.06, share=0.97)


def test_exported_scannet_folders_are_preferred_to_the_sens_file(tmp_path: Path) -> None:
    (tmp_path / "a.sens").write_bytes(sens())
    (tmp_path / "pose").mkdir()
    (tmp_path / "color").mkdir()
    refuses("no-files color", tmp_path)
