"""A lens that no file says is a warning of the scene, whatever its layout; each tool's numbers mean its own formula."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.posed.frames import Camera
from engine.scene import open_scene
from engine.scene.formats.lens import Distortion, of_colmap, of_nerfstudio, of_opencv
from tests.scene.formats import test_nerfstudio, test_seven_scenes, test_tum
from tests.scene.formats.room import check_on_room, look_bent, views, write_pair
from tests.scene.refusing import refuses

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
        lambda folder: test_seven_scenes.write_nice(folder, test_seven_scenes.HALF, 1000),
        "Replica's lens is assumed (32 32 31.5 23.5 for 64x48)",
        "cam_params.json",
        json.dumps({"camera": CAMERA}),
    ),
    (lambda folder: test_nerfstudio.write_scene(folder, cx=None), "principal point of the lens is assumed", "", ""),
    (test_nerfstudio.write_scene, "", "", ""),
]


@pytest.mark.parametrize(("write", "told", "file", "text"), ASSUMED)
def test_an_assumed_lens_warns(tmp_path: Path, write: Callable[[Path], Path], told: str, file: str, text: str) -> None:
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


GRID = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.5, 0.5, 7)), -1).reshape(-1, 2)
NUMBERS = (-0.12, 0.05, 0.004, -0.003, 0.02, 0.03, -0.02, 0.01, 0.002, -0.001, 0.003, 0.001)


def shown(lens: Distortion) -> np.ndarray:
    return np.stack(lens.bent(GRID[:, 0], GRID[:, 1]), -1)


@pytest.mark.parametrize("count", [4, 5, 8, 12])
def test_opencv_distortion_matches_opencvs_own_projection(count: int) -> None:
    points = np.concatenate([GRID, np.ones((len(GRID), 1))], -1)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(NUMBERS[:count]))
    np.testing.assert_allclose(shown(of_opencv(NUMBERS[:count])), expected[:, 0], atol=1e-12)


def test_fisheye_distortion_matches_opencv() -> None:
    k = NUMBERS[:4]
    expected = cv2.fisheye.distortPoints(GRID[:, None], np.eye(3), np.array(k))
    lenses = [
        of_colmap("OPENCV_FISHEYE", k),
        of_nerfstudio(dict(zip(("k1", "k2", "k3", "k4"), k, strict=True)), "", True),
    ]
    for lens in lenses:
        assert lens is not None
        np.testing.assert_allclose(shown(lens), expected[:, 0], atol=1e-9)


def test_nerfstudios_k4_is_read_as_nerfstudio_uses_it() -> None:
    """Its camera_utils.py: d = 1 + r (k1 + r (k2 + r (k3 + r k4))) for r = x^2 + y^2."""
    k1, k2, k3, k4, p1, p2 = NUMBERS[:6]
    x, y = GRID.T
    r = x * x + y * y
    d = 1 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    expected = [x * d + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * d + 2 * p2 * x * y + p1 * (r + 2 * y * y)]
    named = {"k1": k1, "k2": k2, "k3": k3, "k4": k4, "p1": p1, "p2": p2}
    np.testing.assert_allclose(shown(of_nerfstudio(named, "OPENCV", False)).T, expected, atol=1e-12)
    np.testing.assert_allclose(
        shown(of_nerfstudio(named, "FULL_OPENCV", False)), shown(of_opencv((k1, k2, p1, p2, k3, k4))), atol=1e-12
    )


def test_colmaps_thin_prism_fisheye_model_is_read_correctly() -> None:
    """Its models.h: with u, v = theta / r (x, y), du = u radial + 2 p1 uv + p2 (theta^2 + 2 u^2) + sx1 theta^2."""
    k1, k2, p1, p2, k3, k4, sx, sy = NUMBERS[:8]
    radius = np.hypot(*GRID.T)
    t = np.arctan(radius)
    u, v = (GRID * (t / np.maximum(radius, 1e-12))[:, None]).T
    radial = k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8
    du = u * radial + 2 * p1 * u * v + p2 * (t**2 + 2 * u**2) + sx * t**2
    dv = v * radial + 2 * p2 * u * v + p1 * (t**2 + 2 * v**2) + sy * t**2
    lens = of_colmap("THIN_PRISM_FISHEYE", NUMBERS[:8])
    assert lens is not None and of_colmap("FOV", (0.9,)) is None
    np.testing.assert_allclose(shown(lens).T, [u + du, v + dv], atol=1e-12)


def test_tum_distortion_numbers_are_read_as_opencvs(tmp_path: Path) -> None:
    test_tum.write_tum(tmp_path)
    lens, bend = test_tum.KINECT, of_opencv((-0.12, 0.05, 0.002, -0.003, 0.01))
    for i, view in enumerate(views()):
        at = 1305031102.17 + i / 30
        files = (tmp_path / "rgb" / f"{at:.6f}.png", tmp_path / "depth" / f"{at + 0.012:.6f}.png")
        write_pair(*files, look_bent(view, lens, bend.bent), 5000)
    calibration = tmp_path / "calibration.txt"
    calibration.write_text("52.5 52.5 31.5 23.5\n-0.12 0.05 0.002 -0.003 0.01\n")
    scene = open_scene(tmp_path)
    assert any("undistorted" in warning for warning in scene.warnings)
    check_on_room(scene, tolerance=0.05, share=0.97, colour_step=30, colour_share=0.93)
    calibration.write_text("52.5 52.5 31.5 23.5 -0.12 0.05\n")
    refuses("intrinsics-incomplete 6", tmp_path)


@pytest.mark.parametrize(
    "extra", [{"b1": 0.4}, {"camera_model": "OPENCV_FISHEYE", "k5": 0.1}, {"equirectangular": True}]
)
def test_distortion_numbers_of_an_unknown_lens_model_are_refused(tmp_path: Path, extra: dict[str, object]) -> None:
    refuses("lens-numbers", test_nerfstudio.write_scene(tmp_path, **extra))
