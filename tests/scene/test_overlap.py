from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engine.scene import Scene, check_scene, open_scene
from engine.scene.checks import Thumbnail, measure_overlap
from tests.tiny_scene import write_tiny_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_tiny_scene(tmp_path_factory.mktemp("scene"), frames=8))


def thumbnails(scene: Scene, axes: np.ndarray | None = None, scale: float = 1.0) -> list[Thumbnail]:
    found = []
    for frame in scene.frames:
        camera = frame.camera.resized(40, 30)
        camera = camera.at(camera.camera_to_world @ (np.eye(4) if axes is None else axes))
        found.append(Thumbnail(frame.name, camera, frame.read_depth((40, 30)) * np.float32(scale)))
    return found


def test_frames_of_one_room_agree(scene: Scene) -> None:
    overlap = measure_overlap(thumbnails(scene))
    assert overlap.overlaps and overlap.lonely == ()
    assert overlap.in_view > 0.5 and overlap.agreement > 0.55


@pytest.mark.parametrize("wrong", [{"axes": np.diag([1.0, -1.0, -1.0, 1.0])}, {"scale": 5.0}, {"scale": 0.1}])
def test_wrong_axes_and_units_give_disagreement(scene: Scene, wrong: dict[str, object]) -> None:
    assert measure_overlap(thumbnails(scene, **wrong)).agreement < 0.2  # type: ignore[arg-type]


def test_a_frame_elsewhere_is_lonely(scene: Scene) -> None:
    views = thumbnails(scene)
    pose = views[3].camera.camera_to_world.copy()
    pose[2, 3] += 50.0
    views[3] = Thumbnail("far", views[3].camera.at(pose), views[3].depth)
    assert measure_overlap(views).lonely == ("far",)


def test_opengl_poses_get_two_warnings(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=8)
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.loadtxt(path) @ np.diag([1.0, -1.0, -1.0, 1.0]))
    scene = open_scene(folder)
    assert "OpenGL" in scene.warnings[0]
    assert check_scene(scene)[0].startswith("frames disagree about where surfaces are")
