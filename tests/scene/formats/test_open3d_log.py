"""Open3D's reconstruction folders: the trajectory log of its documentation, and its own JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import Lens, View, check_on_room, elsewhere, look, opencv_pose, views
from tests.scene.formats.writing import write_pair
from tests.scene.refusing import refuses

PRIMESENSE = Lens(64, 48, 52.5, 52.5, 32.0, 24.0)


def intrinsic(lens: Lens) -> dict[str, object]:
    """Open3D's PinholeCameraIntrinsic: the matrix column by column, integer pixel centres."""
    columns = [lens.fx, 0, 0, 0, lens.fy, 0, lens.cx - 0.5, lens.cy - 0.5, 1]
    return {"width": lens.width, "height": lens.height, "intrinsic_matrix": columns}


def write_images(folder: Path, lens: Lens, colour: str = "color") -> Path:
    for i, view in enumerate(views()):
        write_pair(folder / colour / f"{i:06d}.png", folder / "depth" / f"{i:06d}.png", look(view, lens))
    return folder


def log(seen: list[View]) -> str:
    rows = [[f"{i} {i} {i + 1}", *(" ".join(f"{v:.8f}" for v in row) for row in opencv_pose(v))]
            for i, v in enumerate(seen)]  # fmt: skip
    return "\n".join("\n".join(row) for row in rows) + "\n"


@pytest.mark.parametrize(("colour", "where"), [("color", "scene"), ("image", "."), ("rgb", ".")])
def test_a_log_with_the_usual_lens(tmp_path: Path, colour: str, where: str) -> None:
    write_images(tmp_path, PRIMESENSE, colour)
    (tmp_path / where).mkdir(exist_ok=True)
    (tmp_path / where / "trajectory.log").write_text(log([elsewhere(view) for view in views()]))
    scene = open_scene(tmp_path)
    assert scene.format == "open3d" and any("PrimeSense" in warning for warning in scene.warnings)
    check_on_room(scene)


def test_a_lens_of_its_own(tmp_path: Path) -> None:
    write_images(tmp_path, Lens())
    (tmp_path / "livingroom1-traj.log").write_text(log(views()))
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(intrinsic(Lens())))
    scene = open_scene(tmp_path)
    assert scene.warnings == ()
    check_on_room(scene)


def test_the_log_with_poses_is_read_among_several(tmp_path: Path) -> None:
    write_images(tmp_path, PRIMESENSE)
    (tmp_path / "reconstruction.log").write_text("[Open3D INFO] fragment 000\n")
    (tmp_path / "odometry.log").write_text(log([elsewhere(view) for view in views()]))
    check_on_room(open_scene(tmp_path))
    (tmp_path / "trajectory.log").write_text(log(views()))
    assert open_scene(tmp_path).format == "open3d"


def test_the_trajectory_of_the_pictures_is_read_among_several(tmp_path: Path) -> None:
    write_images(tmp_path, PRIMESENSE)
    (tmp_path / "trajectory.log").write_text(log(views()[:2]))
    (tmp_path / "first.log").write_text(log(views()[:3]))
    refuses("as there are pictures, 6: trajectory.log has 2, first.log has 3", tmp_path)
    (tmp_path / "second.log").write_text(log([elsewhere(view) for view in views()]))
    check_on_room(open_scene(tmp_path))


def test_open3ds_own_trajectory(tmp_path: Path) -> None:
    write_images(tmp_path, Lens())
    parameters = []
    for view in views():
        rows = np.stack([view.right, -view.up, view.forward])
        world_to_camera = np.vstack([np.column_stack([rows, -rows @ view.eye]), [0, 0, 0, 1]])
        parameters.append({"extrinsic": world_to_camera.T.ravel().tolist(), "intrinsic": intrinsic(Lens())})
    content = {"class_name": "PinholeCameraTrajectory", "parameters": parameters}
    (tmp_path / "trajectory.json").write_text(json.dumps(content))
    check_on_room(open_scene(tmp_path))
