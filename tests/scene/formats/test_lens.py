"""A lens that no file says is a warning of the scene, whatever its layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from engine.posed.frames import Camera
from engine.scene import open_scene
from tests.scene.formats import test_nerfstudio, test_replica, test_seven_scenes, test_tum

CAMERA = {"w": 64, "h": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5, "scale": 1000}
# Who writes the scene, what the warning tells, and the file with which there is none.
ASSUMED: list[tuple[Callable[[Path], Path], str, str, str]] = [
    (test_seven_scenes.write_seven, "a Kinect's lens is assumed (525 525 320 240 for 640x480)", "", ""),
    (test_tum.write_tum, "a Kinect's lens is assumed (525 525 319.5 239.5", "calibration.txt", "52.5 52.5 31.5 23.5"),
    (
        lambda folder: test_tum.write_tum(folder / "rgbd_dataset_freiburg3_office"),
        "freiburg3's lens is assumed (535.4 539.2 320.1 247.6",
        "calibration.txt",
        "53.54 53.92 31.56 24.31",
    ),
    (
        lambda folder: test_replica.write_nice(folder, test_replica.HALF, 1000),
        "Replica's lens is assumed (32 32 31.5 23.5 for 64x48)",
        "cam_params.json",
        json.dumps({"camera": CAMERA}),
    ),
    (lambda folder: test_nerfstudio.write_scene(folder, cx=None), "principal point of the lens is assumed", "", ""),
    (test_nerfstudio.write_scene, "", "", ""),
]


@pytest.mark.parametrize(("write", "told", "file", "text"), ASSUMED)
def test_an_assumed_lens_is_a_warning(
    tmp_path: Path, write: Callable[[Path], Path], told: str, file: str, text: str
) -> None:
    place = write(tmp_path)
    before = open_scene(place)
    assert [told in warning for warning in before.warnings if "assumed" in warning] == [True] * bool(told)
    if file:
        (place / file).write_text(text)
        after = open_scene(place)
        assert not any("assumed" in warning for warning in after.warnings)
        assert lens_of(after.frames[0].camera) == pytest.approx(lens_of(before.frames[0].camera))


def lens_of(camera: Camera) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy]
