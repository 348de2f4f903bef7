"""3D Scanner App's *All Data*: a pose for each depth map, a picture for every second one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import Lens, View, check_on_room, look, opengl_pose, views, y_up
from tests.scene.formats.writing import in_steps, write_colour, write_grey
from tests.scene.refusing import refuses

LENS = Lens().scaled(2)
DEPTH = Lens()


def table(view: View) -> dict[str, object]:
    """ARKit's world, y up; the matrices row by row."""
    pose = opengl_pose(y_up(view))
    intrinsics = [LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1]
    return {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": intrinsics, "motionQuality": 1}


def write_scanner_app(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for i, view in enumerate(views()):
        for number in (2 * i, 2 * i + 1):
            depth, level = in_steps(look(view, DEPTH).depth, 1000), np.full((48, 64), 2, np.uint8)
            depth[:5], level[:5] = 4999, 0
            write_grey(folder / f"depth_{number:05d}.png", depth)
            write_grey(folder / f"conf_{number:05d}.png", level)
            (folder / f"frame_{number:05d}.json").write_text(json.dumps(table(view)))
        write_colour(folder / f"frame_{2 * i:05d}.jpg", look(view, LENS).colour)
    write_colour(folder / "thumb_00000.jpg", np.zeros((8, 8, 3), np.uint8))
    (folder / "info.json").write_text('{"title": "Scan"}')
    return folder


def test_points_lie_on_the_room(tmp_path: Path) -> None:
    scene = open_scene(write_scanner_app(tmp_path))
    assert scene.format == "scanner-app" and [frame.name for frame in scene.frames][1] == "frame_00002"
    check_on_room(scene, colour_step=60)
    assert not scene.frames[0].depth()[:5].any()


def test_a_scan_without_depth_and_a_picture_without_a_pose(tmp_path: Path) -> None:
    for path in (*write_scanner_app(tmp_path).glob("*.png"), tmp_path / "frame_00004.json"):
        path.unlink()
    scene = open_scene(tmp_path)
    assert len(scene.frames) == len(views()) - 1 and not scene.has_depth
    assert any("without a pose is left out: frame_00004" in warning for warning in scene.warnings)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"intrinsics": [LENS.fx, 0, 0, 0, LENS.fy, 0, LENS.cx, LENS.cy, 1]}, "intrinsics are not fx 0 cx"),
        ({"cameraPoseARFrame": np.ravel(opengl_pose(views()[0]), "F").tolist()}, "last row of the pose"),
        ({"cameraPoseARFrame": [0.0]}, '"cameraPoseARFrame" of the frame must be 16 numbers'),
    ],
)
def test_what_is_not_written_row_by_row_is_refused(tmp_path: Path, changed: dict[str, object], told: str) -> None:
    write_scanner_app(tmp_path)
    (tmp_path / "frame_00002.json").write_text(json.dumps(table(views()[1]) | changed))
    refuses(told, tmp_path)


def test_photos_with_notes_of_another_program_are_still_photos(tmp_path: Path) -> None:
    for path in write_scanner_app(tmp_path).glob("frame_*.json"):
        path.write_text('{"shapes": []}')
    refuses("Photos need poses", tmp_path)
