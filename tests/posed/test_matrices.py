"""Cameras, and the matrices in files that they come from."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from engine.posed.matrices import TO_Z_UP, read_matrix, read_poses, turned, up_axis_warning
from engine.scene import Camera, UpAxis
from tests.raises_key import raises_key
from tests.tiny_scene import tiny_pose

lengths = st.floats(20.0, 400.0)
sizes = st.tuples(st.integers(4, 40), st.integers(4, 40))


def camera(size: tuple[int, int], fx: float = 50.0, fy: float = 60.0, pose: np.ndarray | None = None) -> Camera:
    width, height = size
    return Camera(width, height, fx, fy, width * 0.6, height * 0.4, tiny_pose(1, 6) if pose is None else pose)


@given(sizes, lengths, lengths, st.floats(0.05, 60.0), st.integers(0, 5))
def test_projecting_reverses_unproject(size: tuple[int, int], fx: float, fy: float, metres: float, index: int) -> None:
    one = camera(size, fx, fy, tiny_pose(index, 6))
    pixels, depth = one.project(one.unproject(np.full(size[::-1], metres, np.float32)))
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1), atol=1e-6)
    np.testing.assert_allclose(depth, np.float32(metres), rtol=1e-9)


@given(sizes, sizes, st.floats(0.1, 20.0))
def test_a_resized_camera_sees_the_same_part(size: tuple[int, int], other: tuple[int, int], metres: float) -> None:
    one = camera(size)
    point = one.centre + one.camera_to_world[:3, :3] @ np.array([0.1, -0.2, metres])
    pixels, depth = one.project(point)
    resized, same_depth = one.resized(*other).project(point)
    np.testing.assert_allclose(resized / np.array(other), pixels / np.array(size), atol=1e-9)
    assert depth == same_depth


def written(folder: Path, matrix: np.ndarray, form: str = "%.18e") -> Path:
    np.savetxt(folder / "matrix.txt", matrix, fmt=form)
    return folder / "matrix.txt"


@pytest.mark.parametrize("text", ["1 2\n3 4\n", "1,2\n3,4", "\n1\t2  \n\n 3 4", "1e0 2.0\r\n3 4\r\n"])
def test_matrix_files_are_read_in_many_notations(tmp_path: Path, text: str) -> None:
    (tmp_path / "matrix.txt").write_text(text)
    assert read_matrix(tmp_path / "matrix.txt", ((2, 2),)).tolist() == [[1.0, 2.0], [3.0, 4.0]]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30, deadline=None)
@given(st.integers(0, 9), st.sampled_from(["%.18e", "%.6f", "%.4f"]))
def test_a_rounded_pose_is_made_rigid_again(tmp_path: Path, index: int, form: str) -> None:
    pose = read_poses({"a": written(tmp_path, tiny_pose(index, 10), form)})["a"]
    assert pose is not None
    np.testing.assert_allclose(pose, tiny_pose(index, 10), atol=2e-4)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-14)
    assert pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]


def test_a_pose_of_infinities_is_missing_but_nan_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "pose.txt").write_text("-inf -inf -inf -inf\n" * 4)
    assert read_poses({"a": tmp_path / "pose.txt"}) == {"a": None}
    (tmp_path / "pose.txt").write_text("nan -inf -inf -inf\n" * 4)
    with raises_key("nan"):
        read_poses({"a": tmp_path / "pose.txt"})


def test_cameras_upright_about_another_axis_are_noticed() -> None:
    upright = [tiny_pose(index, 6) for index in range(6)]
    assert up_axis_warning(upright, "z") is None
    y_up = np.eye(4)
    y_up[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    message = up_axis_warning([y_up @ pose for pose in upright], "z")
    assert message is not None and "is the axis y, not z" in message and "--up y" in message
    message = up_axis_warning([np.diag([1.0, -1.0, -1.0, 1.0]) @ pose for pose in upright], "y")
    assert message is not None and "--up -y" in message
    x_up = np.eye(4)
    x_up[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    message = up_axis_warning([x_up @ pose for pose in upright], "z")
    assert message is not None and "turn the poses so that z points up" in message


def test_cameras_that_look_straight_down_do_not_reveal_the_up_axis() -> None:
    down = np.eye(4)
    down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    turned = np.eye(4)
    turned[:2, :2] = -np.eye(2)
    assert up_axis_warning([down, turned @ down], "z") is None


@pytest.mark.parametrize(("up", "axis"), [("z", [0, 0, 1]), ("y", [0, 1, 0]), ("-y", [0, -1, 0])])
def test_the_named_up_axis_is_turned_to_z(up: UpAxis, axis: list[int]) -> None:
    pose = np.eye(4)
    pose[:3, 3] = axis
    upright = turned(pose, TO_Z_UP[up])
    np.testing.assert_allclose(upright[:3, 3], [0, 0, 1], atol=1e-15)
    assert np.linalg.det(upright[:3, :3]) == pytest.approx(1.0)
