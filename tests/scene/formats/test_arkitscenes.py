"""ARKitScenes: a video's folder of the raw data, and one of 3dod."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import Lens, in_steps, look, opencv_pose, views, write_colour, write_grey
from tests.scene.refusing import refuses

LENS, DEPTH = Lens().scaled(2), Lens()


def row(seconds: float, camera_to_world: np.ndarray) -> str:
    """A line of the trajectory: world-to-camera, its rotation as OpenCV's Rodrigues has it."""
    pose = np.linalg.inv(camera_to_world)
    return " ".join(map(str, [f"{seconds:.6f}", *cv2.Rodrigues(pose[:3, :3])[0].ravel(), *pose[:3, 3]]))


def write_video(folder: Path, kind: str) -> Path:
    """Pictures stand between poses and hang off them by milliseconds, as theirs do."""
    rows = []
    for number, view in enumerate(views()):
        name, seconds = f"40777060_{98.7 + number / 3:.3f}", 98.7 + number / 3
        write_colour(folder / kind / f"{name}.png", look(view, LENS).colour)
        write_grey(folder / "lowres_depth" / f"{name}.png", in_steps(look(view, DEPTH).depth, 1000))
        write_grey(folder / "confidence" / f"{name}.png", np.full((48, 64), 2, np.uint8))
        table = folder / f"{kind}_intrinsics" / f"{name}.pincam"
        table.parent.mkdir(exist_ok=True)
        table.write_text(f"{LENS.width} {LENS.height} {LENS.fx} {LENS.fy} {LENS.cx} {LENS.cy}")
        pose = opencv_pose(view)
        turn = np.eye(4)
        turn[:3, :3], turn[:3, 3] = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0], (0.02, 0.01, -0.03)
        moved = turn.copy()
        moved[:3, 3] = pose[:3, :3] @ turn[:3, 3]
        for way, at in ((-1.0, -0.04), (1.0, 0.04)):  # the picture lies half-way between the two
            end = pose.copy()
            end[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(way * np.array([0.01, -0.02, 0.03]))[0]
            end[:3, 3] = pose[:3, 3] + way * moved[:3, 3]
            rows.append(row(seconds + at, end))
    (folder / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    return folder


def test_arkitscenes_pictures_far_in_time_from_any_pose_are_left_out(tmp_path: Path) -> None:
    write_video(tmp_path, "wide")
    path = tmp_path / "lowres_wide.traj"
    path.write_text("\n".join(path.read_text().splitlines()[:-2]))
    scene = open_scene(tmp_path)
    assert len(scene.frames) == len(views()) - 1
    assert any("without a pose is left out: 40777060_100.367" in warning for warning in scene.warnings)


@pytest.mark.parametrize(
    ("file", "content", "told"),
    [
        ("lowres_wide.traj", "1 2 3\n", "wrong-count"),
        ("lowres_wide.traj", "\n", "no-poses-left"),
        ("wide_intrinsics/40777060_98.700.pincam", "", "no-camera"),
        ("wide_intrinsics/40777060_98.700.pincam", "64 48 50 50", "wrong-count"),
        ("wide_intrinsics/first.pincam", "64 48 50 50 32 24", "no-time-stamp"),
    ],
)
def test_damaged_arkitscenes_files_are_named(tmp_path: Path, file: str, content: str, told: str) -> None:
    write_video(tmp_path, "wide")
    (tmp_path / file).write_text(content)
    refuses(told, tmp_path)
