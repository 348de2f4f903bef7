"""Pictures for people: from the command line that README names, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import bpy
import cv2
import numpy as np
import pytest
from plgs.plgs_blender.lift_scene import save_lift

from docs.make_pictures.room import main
from tests.commands import exit_code


def run(root: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "docs.make_pictures.room", *map(str, arguments)]
    return subprocess.run(command, cwd=root, env=os.environ, capture_output=True, text=True, timeout=120)


def test_a_picture_shows_points_and_boxes(lift: Path, tmp_path: Path, root: Path) -> None:
    save_lift(lift, tmp_path / "lift.blend")
    before = (tmp_path / "lift.blend").read_bytes()
    done = run(root, tmp_path / "lift.blend", tmp_path / "out.png", "--size", "640x400", "--no-labels")
    assert done.returncode == 0, done.stderr
    picture = cv2.imread(str(tmp_path / "out.png")).astype(int)
    assert picture.shape == (400, 640, 3)
    blue, green, red = np.moveaxis(picture, -1, 0)
    assert np.mean((red > 140) & (green < 110) & (blue < 110)) > 0.005  # the chair's class
    assert np.mean((red > 190) & (green > 130) & (blue < 100)) > 0.0003  # the chair's box
    assert np.mean(picture.sum(axis=-1) > 150) > 0.2  # the room
    assert (tmp_path / "lift.blend").read_bytes() == before


def test_bad_arguments_are_one_line_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "empty.blend"))
    for arguments, message in (
        ((tmp_path / "none.blend", tmp_path / "out.png"), "does not exist"),
        ((tmp_path / "empty.blend", tmp_path / "out.png"), "no view 'Overview'"),
        ((tmp_path / "empty.blend", tmp_path / "out.png", "--size", "big"), "WIDTHxHEIGHT"),
    ):
        assert exit_code(main, *arguments) == 2
        assert message in capsys.readouterr().err
