"""TUM RGB-D's file formats as its documentation has them."""

from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import Lens, check_on_room, look, quaternion, views, write_colour, write_pair, y_up
from tests.scene.refusing import refuses

# 525 525 319.5 239.5 of 640x480, integer centres, for a tenth of the size with centres at +0.5.
KINECT = Lens(64, 48, 52.5, 52.5, 32.0, 24.0)


def tum_line(stamp: float | int, right: np.ndarray, down: np.ndarray, forward: np.ndarray, eye: np.ndarray) -> str:
    w, x, y, z = quaternion(np.stack([right, down, forward], axis=1))
    return f"{stamp} " + " ".join(f"{value:.7f}" for value in (*eye, x, y, z, w)) + "\n"


def write_tum(folder: Path) -> Path:
    """Depth 12 ms after colour, poses every 10 ms that move on between pictures, pictures before and after them."""
    rgb, depth = "# color images\ntimestamp filename\n", "# depth maps\n"
    truth = "# ground truth trajectory\n# timestamp tx ty tz\n"
    for i, view in enumerate(views()):
        at = 1305031102.17 + i / 30
        write_pair(
            folder / "rgb" / f"{at:.6f}.png", folder / "depth" / f"{at + 0.012:.6f}.png", look(view, KINECT), 5000
        )
        rgb += f"{at:.6f} rgb/{at:.6f}.png\n"
        depth += f"{at + 0.012:.6f} depth/{at + 0.012:.6f}.png\n"
        for late in (-0.009, 0.001, 0.011):
            moved = view.eye + (late - 0.001) * np.array([5.0, 3.0, 0.0])
            truth += tum_line(round(at + late, 4), view.right, -view.up, view.forward, moved)
    write_colour(folder / "rgb" / "1305031100.000000.png", np.zeros((48, 64, 3), np.uint8))
    rgb += "1305031100.000000 rgb/1305031100.000000.png\n"
    for name, text in (("rgb", rgb), ("depth", depth), ("groundtruth", truth)):
        (folder / f"{name}.txt").write_text(text)
    return folder


@pytest.mark.parametrize("by_number", [False, True])
def test_numbered_poses_exported_by_rtabmap_are_read(tmp_path: Path, by_number: bool) -> None:
    lines = "#timestamp x y z qx qy qz qw id\n"
    for i, view in enumerate(views(), start=1):
        at = 1675933810.3 + i / 2
        name = f"{i}.png" if by_number else f"{at:.6f}.png"
        write_pair(tmp_path / "rgb" / name, tmp_path / "depth" / name, look(view, KINECT), 5000)
        lines += f"{tum_line(at, view.right, -view.up, view.forward, view.eye).strip()} {i}\n"
    (tmp_path / "groundtruth.txt").write_text(lines)
    scene = open_scene(tmp_path)
    assert len(scene.frames) == len(views())
    check_on_room(scene)


def test_the_tum_lens_comes_from_the_folder_name_or_calibration_txt(tmp_path: Path) -> None:
    bent = open_scene(write_tum(tmp_path / "rgbd_dataset_freiburg1_desk"))
    assert not bent.frames[0].file_shows_colour and any("undistorted" in warning for warning in bent.warnings)
    (tmp_path / "rgbd_dataset_freiburg1_desk" / "calibration.txt").write_text("52.5 52.5 31.5 23.5\n")
    check_on_room(open_scene(tmp_path / "rgbd_dataset_freiburg1_desk"))


@pytest.mark.parametrize("depth_first", [True, False])
def test_tum_associations_are_read_in_either_column_order(tmp_path: Path, depth_first: bool) -> None:
    write_tum(tmp_path)
    lines = []
    for i in range(6):
        at = 1305031102.17 + i / 30
        pair = [f"{at + 0.012:.6f} depth/{at + 0.012:.6f}.png", f"{at:.6f} rgb/{at:.6f}.png"]
        lines.append(" ".join(pair if depth_first else pair[::-1]))
    (tmp_path / "associations.txt").write_text("\n".join(lines))
    (tmp_path / "rgb.txt").unlink()
    check_on_room(open_scene(tmp_path))


def test_tum_time_stamps_come_from_picture_names_without_depth(tmp_path: Path) -> None:
    write_tum(tmp_path)
    for name in ("rgb.txt", "depth.txt"):
        (tmp_path / name).unlink()
    check_on_room(open_scene(tmp_path))
    (tmp_path / "depth").rename(tmp_path / "elsewhere")
    assert not open_scene(tmp_path).has_depth


def test_icl_nuim_scenes_are_refused_with_advice(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n")
    refuses("whole-time-stamps", tmp_path)


def test_a_tum_scene_with_another_up_axis_is_rotated(tmp_path: Path) -> None:
    write_tum(tmp_path)
    text = "".join(
        tum_line(round(1305031102.171 + i / 30, 4), v.right, -v.up, v.forward, v.eye)
        for i, v in enumerate(map(y_up, views()))
    )
    (tmp_path / "groundtruth.txt").write_text(text)
    check_on_room(open_scene(tmp_path, up="y"))
    known, said = (open_scene(tmp_path, up=up) for up in ("z", "+z"))
    assert any("turned so that the cameras stand upright" in warning for warning in known.warnings)
    assert any("is the axis y, not z" in warning for warning in said.warnings)
    assert said.frames[0].camera.camera_to_world[:3, 3] == pytest.approx(y_up(views()[0]).eye)
