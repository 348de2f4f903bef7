"""transforms.json as nerfstudio's documentation and instant-ngp's describe it."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from engine.scene.formats.lens import of_nerfstudio
from tests.scene.formats import room

LENS = room.Lens()
SHARED = {"w": 64, "h": 48, "fl_x": LENS.fx, "fl_y": LENS.fy, "cx": LENS.cx, "cy": LENS.cy, "camera_model": "OPENCV"}


def write_scene(folder: Path, depth: bool = True, **shared: Any) -> Path:
    """Frames in the file are in another order than their names, as COLMAP leaves them."""
    frames = []
    for i, view in enumerate(room.views()):
        picture = room.look(view, LENS)
        name = f"frame_{i + 8}"
        room.write_colour(folder / "images" / f"{name}.png", picture.colour)
        frame: dict[str, Any] = {
            "file_path": f"./images/{name}.png",
            "transform_matrix": room.opengl_pose(view).tolist(),
        }
        if depth:
            room.write_grey(folder / "depth" / f"{name}.png", room.in_steps(picture.depth, 1000))
            frame["depth_file_path"] = f"depth/{name}.png"
        frames.insert(i // 2, frame)
    content = SHARED | shared | {"frames": frames}
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    return folder


def test_nerfstudio_frames_with_missing_pictures_are_left_out(tmp_path: Path) -> None:
    """instant-ngp's own sample names more pictures than it has."""
    write_scene(tmp_path)
    (tmp_path / "images" / "frame_9.png").unlink()
    scene = open_scene(tmp_path)
    assert len(scene.frames) == 5 and "1 frame without a picture is left out: ./images/frame_9.png" in scene.warnings


@pytest.mark.parametrize("step", [None, 0.1, 0.001, 0.0002])
def test_nerfstudio_depth_arrays_and_scaled_poses_become_metres(tmp_path: Path, step: float | None) -> None:
    """A .npy has nerfstudio's factor, too, and ``applied_scale`` multiplied the poses, not the depth."""
    write_scene(tmp_path, applied_scale=0.5, depth_unit_scale_factor=step)
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        png = tmp_path / frame["depth_file_path"]
        frame["depth_file_path"] = frame["depth_file_path"].replace(".png", ".npy")
        metres = cv2.imread(str(png), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
        np.save(png.with_suffix(".npy"), metres / (step or 1.0))
        frame["transform_matrix"] = [[*row[:3], 0.5 * row[3]] for row in frame["transform_matrix"][:3]]
    path.write_text(json.dumps(content))
    room.check_on_room(open_scene(tmp_path))


def test_transforms_json_with_paths_of_another_folder_finds_its_pictures(tmp_path: Path) -> None:
    write_scene(tmp_path)
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace("./images/", "../../data/room/images/"))
    room.check_on_room(open_scene(tmp_path))


def test_splits_of_nerfs_synthetic_scenes_are_used(tmp_path: Path) -> None:
    """As Blender's script for them writes: an angle of view, no suffix, and equal names in each part."""
    straight = room.Lens(64, 48, 50.0, 50.0, 32.0, 24.0)
    for part, own in (("train", room.views()[:4]), ("test", room.views()[4:]), ("val", room.views()[:2])):
        frames = []
        for i, view in enumerate(own):
            room.write_colour(tmp_path / part / f"r_{i}.png", room.look(view, straight).colour)
            frames.append(
                {"file_path": f"./{part}/r_{i}", "rotation": 0.1, "transform_matrix": room.opengl_pose(view).tolist()}
            )
        content = {"camera_angle_x": 2 * math.atan(32 / 50), "frames": frames}
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(content))
    scene = open_scene(tmp_path)
    assert scene.format == "nerfstudio"
    assert [frame.name for frame in scene.train_frames] == ["train_r_0", "train_r_1", "train_r_2", "train_r_3"]
    assert [frame.name for frame in scene.test_frames] == ["test_r_0", "test_r_1"]
    assert scene.frames[0].camera.fx == pytest.approx(50.0)
    room.check_colours(scene)


def test_keys_of_instant_ngp_in_transforms_json_are_read(tmp_path: Path) -> None:
    """Angles instead of focal lengths, images without suffix, depth in steps of its own."""
    angles = {"camera_angle_x": 2 * math.atan(32 / LENS.fx), "camera_angle_y": 2 * math.atan(24 / LENS.fy)}
    write_scene(tmp_path, **angles, fl_x=None, fl_y=None, camera_model=None, integer_depth_scale=1 / 2000)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
        frame["depth_path"] = frame.pop("depth_file_path")
    for i, view in enumerate(room.views()):
        room.write_grey(tmp_path / "depth" / f"frame_{i + 8}.png", room.in_steps(room.look(view, LENS).depth, 2000))
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    room.check_on_room(open_scene(tmp_path))


def test_nerfstudio_intrinsics_of_larger_pictures_are_scaled(tmp_path: Path) -> None:
    write_scene(tmp_path, w=128, h=96, fl_x=2 * LENS.fx, fl_y=2 * LENS.fy, cx=2 * LENS.cx, cy=2 * LENS.cy)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        png = tmp_path / frame["depth_file_path"]
        np.save(
            png.with_suffix(".npy"), cv2.imread(str(png), cv2.IMREAD_UNCHANGED).astype(np.float32)[..., None] / 1000
        )
        frame["depth_file_path"] = frame["depth_file_path"].replace(".png", ".npy")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    room.check_on_room(open_scene(tmp_path))


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_nerfstudio_lens_distortion_is_removed(tmp_path: Path, model: str) -> None:
    """test_lens.py compares the formulas with OpenCV's and nerfstudio's own."""
    bent = {"k1": -0.12, "k2": 0.05, "p1": 0.004, "p2": -0.003}
    if model == "OPENCV_FISHEYE":
        bent = {"k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": 0.0}
    lens, bend = LENS.scaled(4), of_nerfstudio(bent, model, model == "OPENCV_FISHEYE")
    write_scene(tmp_path, **bent, w=256, h=192, fl_x=lens.fx, fl_y=lens.fy, cx=lens.cx, cy=lens.cy, camera_model=model)
    for i, view in enumerate(room.views()):
        picture = room.look_bent(view, lens, bend.bent)
        room.write_pair(tmp_path / "images" / f"frame_{i + 8}.png", tmp_path / "depth" / f"frame_{i + 8}.png", picture)
    scene = open_scene(tmp_path)
    assert any("undistorted" in warning for warning in scene.warnings)
    assert not scene.frames[0].file_shows_colour
    # Depth takes the nearest pixel, up to 0.7 pixels aside: 1 cm at a slant.
    room.check_on_room(scene, tolerance=0.012, share=0.97)
    assert scene.frames[0].depth((64, 48)).shape == (48, 64)


def test_nerfstudio_points_and_cameras_are_turned_upright_together(tmp_path: Path) -> None:
    """nerfstudio leaves COLMAP's world turned as it was; sparse_pc.ply lies in the same world."""
    write_scene(tmp_path, ply_file_path="sparse_pc.ply")
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        index = int(frame["file_path"].split("_")[1].split(".")[0]) - 8
        frame["transform_matrix"] = room.opengl_pose(room.elsewhere(room.views()[index])).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    marks = [room.elsewhere(view).eye + room.elsewhere(view).forward for view in room.views()]
    header = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    header += "property uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n"
    rows = "".join(f"{x:.6f} {y:.6f} {z:.6f} 10 20 30\n" for x, y, z in marks)
    (tmp_path / "sparse_pc.ply").write_text(header + rows)
    scene = open_scene(tmp_path)
    assert any("which way is up" in warning for warning in scene.warnings)
    room.check_on_room(scene)
    assert scene.points is not None and scene.points.rgb[0].tolist() == [10, 20, 30]
    for frame, point in zip(scene.frames, scene.points.xyz, strict=True):
        np.testing.assert_allclose(point, frame.camera.centre + frame.camera.camera_to_world[:3, 2], atol=1e-5)
