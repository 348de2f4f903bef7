"""Stray Scanner's folders, as StrayVisualizer's README and reader describe them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.scene import open_scene
from engine.scene.formats.photos import Video
from tests.scene.formats.room import Lens, View, check_on_room, look, quaternion, views, y_up
from tests.scene.formats.writing import in_steps, write_grey

LENS = Lens().scaled(4)
DEPTH = Lens()


def held_upright(view: View) -> View:
    """A phone held upright: its pictures lie on their side."""
    return View(view.eye, -view.up, view.right, view.forward)


def write_stray(folder: Path, older: bool = False, sideways: bool = False) -> Path:
    """The odometry starts with a frame that tracking had lost, and skips a frame of the video."""
    folder.mkdir(exist_ok=True)
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60, (LENS.width, LENS.height))
    lines = "timestamp, frame, x, y, z, qx, qy, qz, qw\n1.5, 000000, nan, 0, 0, 0, 0, 0, 1\n"
    for i, plain in enumerate([views()[0], views()[0], *views()]):
        view = held_upright(plain) if sideways else plain
        video.write(np.ascontiguousarray(look(view, LENS).colour[..., ::-1]))
        if i == 1:
            continue
        depth, level = in_steps(look(view, DEPTH).depth, 1000), np.full((48, 64), 1, np.uint8)
        depth[:5], level[:5] = 4999, 0
        if older:
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / "depth" / f"{i:06d}.npy", depth)
        else:
            write_grey(folder / "depth" / f"{i:06d}.png", depth)
        write_grey(folder / "confidence" / f"{i:06d}.png", level)
        if i > 1:
            seen = y_up(view)
            w, x, y, z = quaternion(np.stack([seen.right, -seen.up, seen.forward], axis=1))
            lines += f"{2 + i / 60:.4f}, {i:06d}, " + ", ".join(f"{v:.7f}" for v in (*seen.eye, x, y, z, w)) + "\n"
    video.release()
    (folder / "odometry.csv").write_text(lines)
    rows = [[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]]
    (folder / "camera_matrix.csv").write_text("".join(", ".join(map(str, row)) + "\n" for row in rows))
    return folder


@pytest.mark.parametrize("older", [True, False])
def test_points_lie_on_the_room(tmp_path: Path, older: bool) -> None:
    scene = open_scene(write_stray(tmp_path, older))
    assert scene.format == "stray" and [frame.name for frame in scene.frames] == [f"{i:06d}" for i in range(2, 8)]
    assert "1 frame without a pose is left out: 000000" in scene.warnings
    check_on_room(scene, colour_step=60)  # the video's compression
    assert not scene.frames[0].depth()[:5].any() and not scene.frames[0].file_shows_colour


def test_todays_app_writes_two_more_columns_which_are_empty(tmp_path: Path) -> None:
    write_stray(tmp_path)
    path = tmp_path / "odometry.csv"
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{head}, horizontal_accuracy, heading", *(f"{row}, , " for row in rows)]) + "\n")
    check_on_room(open_scene(tmp_path), colour_step=60)


def test_pictures_come_in_any_order(tmp_path: Path) -> None:
    scene = open_scene(write_stray(tmp_path))
    last = scene.frames[5].read_colour(None)
    first = scene.frames[0].read_colour(None)
    assert np.abs(first.astype(int) - last).mean() > 20
    np.testing.assert_array_equal(scene.frames[5].read_colour(None), last)


def test_a_phone_held_upright_still_has_y_up(tmp_path: Path) -> None:
    scene = open_scene(write_stray(tmp_path, sideways=True))
    assert not any("up" in warning for warning in scene.warnings)
    check_on_room(scene, colour_step=60)


def test_the_size_comes_from_the_header(tmp_path: Path) -> None:
    write_stray(tmp_path)
    assert Video(tmp_path / "rgb.mp4").size() == (LENS.width, LENS.height)
    (tmp_path / "other.mkv").write_bytes(b"\x1a\x45\xdf\xa3" * 20)
    with pytest.raises(PlgsError, match="cannot be opened"):
        Video(tmp_path / "other.mkv").size()
