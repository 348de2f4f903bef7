"""Polycam's raw export, as polyform's README specifies it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import Lens, View, check_on_room, look, views, y_up
from tests.scene.formats.writing import in_steps, write_colour, write_grey

LENS = Lens().scaled(2)
DEPTH = Lens()


def camera_json(view: View, lens: Lens) -> str:
    """ARKit's world, y up; the camera's x right, y up, z backward are the columns of t."""
    seen = y_up(view)
    t = np.stack([seen.right, seen.up, -seen.forward, seen.eye], axis=1)
    entry = {f"t_{row}{column}": float(t[row, column]) for row in range(3) for column in range(4)}
    entry |= {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "width": lens.width, "height": lens.height}
    return json.dumps(entry | {"blur_score": 81.2, "timestamp": 1})


def write_polycam(folder: Path, corrected: bool = True) -> Path:
    """The plain images and cameras are not as good as the corrected ones: here they are grey and elsewhere."""
    keyframes = folder / "keyframes"
    for kind in ("cameras", "corrected_cameras"):
        (keyframes / kind).mkdir(parents=True)
    for i, view in enumerate(views()):
        name = str(98765432100 + 7 * i)
        moved = View(view.eye + 0.3, view.right, view.up, view.forward)
        for prefix, seen in (("", moved if corrected else view), ("corrected_", view)):
            write_colour(keyframes / f"{prefix}images" / f"{name}.png", look(seen, LENS).colour)
            (keyframes / f"{prefix}cameras" / f"{name}.json").write_text(camera_json(seen, LENS))
        depth, level = in_steps(look(view, DEPTH).depth, 1000), np.full((48, 64), 127, np.uint8)
        depth[:5], level[:5] = 4999, 0
        write_grey(keyframes / "depth" / f"{name}.png", depth)
        write_grey(keyframes / "confidence" / f"{name}.png", level)
    if not corrected:
        for kind in ("corrected_cameras", "corrected_images"):
            shutil.rmtree(keyframes / kind)
    return folder


@pytest.mark.parametrize("corrected", [True, False])
def test_points_lie_on_the_room(tmp_path: Path, corrected: bool) -> None:
    scene = open_scene(write_polycam(tmp_path, corrected))
    assert scene.format == "polycam" and scene.frames[0].name == "98765432100"
    assert any("not optimised" in warning for warning in scene.warnings) is not corrected
    check_on_room(scene)
    assert not scene.frames[0].depth()[:5].any()


def without_size(folder: Path, kind: str = "corrected_cameras", **other: float) -> None:
    for path in (folder / "keyframes" / kind).iterdir():
        entry = json.loads(path.read_text())
        path.write_text(json.dumps({key: entry[key] for key in entry if key not in ("width", "height")} | other))


@pytest.mark.parametrize("scale", [1, 2])
def test_a_size_that_cameras_do_not_say_is_inferred(tmp_path: Path, scale: int) -> None:
    """Newer exports have no width and height in corrected_cameras. Its numbers may be for larger pictures."""
    write_polycam(tmp_path)
    lens = LENS.scaled(scale)
    numbers = {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy}
    without_size(tmp_path, **numbers)
    without_size(tmp_path, "cameras", **numbers, width=128 * scale, height=96 * scale)
    scene = open_scene(tmp_path)
    check_on_room(scene)
    assert any("the size of the pictures of 6 cameras" in warning for warning in scene.warnings)


@pytest.mark.parametrize("kept", [3, 1, 0])
def test_keyframes_that_were_not_optimised_are_counted(tmp_path: Path, kept: int) -> None:
    """Their own cameras stand elsewhere, so they are no substitute, unless no keyframe was optimised."""
    keyframes = write_polycam(tmp_path, corrected=kept > 0) / "keyframes"
    names = sorted(path.stem for path in (keyframes / "cameras").iterdir())
    for kind in ("cameras", "images"):
        (keyframes / f"corrected_{kind}").mkdir(exist_ok=True)
    for name in names[kept:] if kept else []:
        (keyframes / "corrected_cameras" / f"{name}.json").unlink()
        (keyframes / "corrected_images" / f"{name}.png").unlink()
    scene = open_scene(tmp_path)
    assert [frame.name for frame in scene.frames] == names[: kept or 6]
    told = f"{6 - kept} of 6 keyframes are not in both corrected_cameras" if kept else "the poses were not optimised"
    assert any(warning.startswith(told) for warning in scene.warnings)
    check_on_room(scene)
