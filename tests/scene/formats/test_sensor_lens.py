"""Lenses in the files of Azure Kinect, RealSense and Open3D, beside pictures of each layout that can lack a lens."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.scene import open_scene
from engine.scene.formats.sensor_lens import find_sensor_lens
from tests.scene.formats.room import Lens, check_on_room, look, opencv_pose, views
from tests.scene.formats.test_open3d_log import intrinsic, log
from tests.scene.formats.test_tum import tum_line
from tests.scene.formats.writing import write_colour, write_pair
from tests.scene.refusing import refuses

LENS = Lens()
REALSENSE = {"width": LENS.width, "height": LENS.height, "fx": LENS.fx, "fy": LENS.fy, "ppx": LENS.cx - 0.5,
             "ppy": LENS.cy - 0.5, "model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}  # fmt: skip
MODEL = "CALIBRATION_LensDistortionModelBrownConrady"


def azure(parameters: list[float], model: str = MODEL) -> dict[str, Any]:
    """The two cameras in a recording's calibration.json; the first numbers are shares of a 4:3 sensor."""
    colour = {"Purpose": "CALIBRATION_CameraPurposePhotoVideo", "SensorWidth": 4096, "SensorHeight": 3072,
              "Intrinsics": {"ModelParameters": parameters, "ModelType": model}}  # fmt: skip
    return {"CalibrationInformation": {"Cameras": [{"Purpose": "CALIBRATION_CameraPurposeDepth"}, colour]}}


def of_lens(lens: Lens) -> list[float]:
    return [lens.cx / lens.width, lens.cy / lens.height, lens.fx / lens.width, lens.fy / lens.height, *[0.0] * 10]


def plain(folder: Path, steps: int) -> None:
    for i, view in enumerate(views()):
        write_pair(folder / f"color/{i:06d}.png", folder / f"depth/{i:06d}.png", look(view, LENS), steps)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i:06d}.txt", opencv_pose(view), "%.7f")


def open3d(folder: Path, steps: int) -> None:
    for i, view in enumerate(views()):
        write_pair(folder / f"color/{i:06d}.png", folder / f"depth/{i:06d}.png", look(view, LENS), steps)
    (folder / "trajectory.log").write_text(log(views()))


def frames(folder: Path, steps: int) -> None:
    for i, view in enumerate(views()):
        base = folder / f"frame-{i:06d}"
        write_pair(Path(f"{base}.color.png"), Path(f"{base}.depth.png"), look(view, LENS), steps)
        np.savetxt(f"{base}.pose.txt", opencv_pose(view), "%.7f")


def tum(folder: Path, steps: int) -> None:
    lines = ""
    for i, view in enumerate(views()):
        write_pair(folder / f"rgb/{i}.5.png", folder / f"depth/{i}.5.png", look(view, LENS), steps)
        lines += tum_line(i + 0.5, view.right, -view.up, view.forward, view.eye)
    (folder / "groundtruth.txt").write_text(lines)


@pytest.mark.parametrize("layout", [plain, open3d, frames, tum])
@pytest.mark.parametrize(
    ("name", "content", "steps"),
    [
        ("calibration.json", azure(of_lens(LENS)), None),
        ("intrinsic.json", intrinsic(LENS) | {"device_name": "Azure Kinect", "depth_mode": "NFOV_UNBINNED"}, None),
        ("camera_intrinsic.json", intrinsic(LENS) | {"depth_scale": 4000.0}, 4000),
        ("intrinsics.json", {"color": REALSENSE, "depth": {"ppx": 1}, "depth_scale": 0.00025}, 4000),
        ("calibration.json", REALSENSE, None),
    ],
)
def test_the_lens_beside_pictures(
    tmp_path: Path, layout: Callable[[Path, int], None], name: str, content: dict[str, Any], steps: int | None
) -> None:
    layout(tmp_path, steps or (5000 if layout is tum else 1000))
    end = b"\0" if "CalibrationInformation" in content else b""
    (tmp_path / name).write_bytes(json.dumps(content).encode() + end)
    scene = open_scene(tmp_path)
    assert not scene.assumed_lens and not any("assumed" in warning for warning in scene.warnings)
    (lens,) = (each for each in scene.inferred if each.about == "lens")
    assert name in lens.taken and not lens.is_doubtful
    check_on_room(scene)


@pytest.mark.parametrize("layout", [plain, open3d, frames, tum])
def test_the_lens_does_not_need_the_first_picture(tmp_path: Path, layout: Callable[[Path, int], None]) -> None:
    layout(tmp_path, 5000 if layout is tum else 1000)
    (tmp_path / "calibration.json").write_text(json.dumps(azure(of_lens(LENS))))
    pictures = [path for path in tmp_path.rglob("*.png") if "depth" not in path.name + path.parent.name]
    min(pictures).write_bytes(b"")
    scene = open_scene(tmp_path)
    assert [len(each.names) for each in scene.left_out] == [1] and len(scene.frames) == len(views()) - 1


def test_an_azure_kinects_modes_and_distortion(tmp_path: Path) -> None:
    """The numbers of one device, and what Microsoft's SDK says of it at 1920x1080 with integer pixel centres."""
    shares = [0.4967627227306366, 0.5108628273010254, 0.470907062292099, 0.6274453997612]
    bent = [0.7227, -2.8856, 1.6327, 0.6022, -2.7196, 1.5651, 0.0, 0.0, -0.000143, 0.000783]
    (tmp_path / "calibration.json").write_text(json.dumps(azure([*shares, *bent])))
    sensor = find_sensor_lens(tmp_path)
    assert sensor is not None
    assert sensor.distortion.coefficients == (0.7227, -2.8856, 0.000783, -0.000143, 1.6327, 0.6022, -2.7196, 1.5651)
    cv2.imwrite(str(tmp_path / "wide.png"), np.zeros((1080, 1920), np.uint8))
    wide = sensor.fitting(tmp_path / "wide.png")
    said = [904.141541, 903.521362, 953.284424 + 0.5, 555.142456 + 0.5]
    np.testing.assert_allclose([wide.fx, wide.fy, wide.cx, wide.cy], said, atol=1e-3)
    cv2.imwrite(str(tmp_path / "narrow.png"), np.zeros((576, 640), np.uint8))  # colour in the depth camera's picture
    with pytest.raises(PlgsError, match="the picture is 640x576"):
        sensor.fitting(tmp_path / "narrow.png")


@pytest.mark.parametrize(
    ("model", "bends", "told"),
    [("distortion.brown_conrady", True, ""), ("Inverse Brown Conrady", False, "inversebrownconrady")],
)
def test_a_realsenses_distortion(tmp_path: Path, model: str, bends: bool, told: str) -> None:
    content = REALSENSE | {"model": model, "coeffs": [-0.05, 0.06, 1e-4, 2e-4, -0.02]}
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    sensor = find_sensor_lens(tmp_path)
    assert sensor is not None and sensor.distortion.bends is bends
    assert told in "".join(sensor.warnings) and bool(told) == bool(sensor.warnings)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (azure(of_lens(LENS), "CALIBRATION_LensDistortionModelTheta"), "of another model"),
        (azure([*of_lens(LENS)[:10], 0.1, 0.0, 0.0, 0.0]), "a centre of its own"),
        (REALSENSE | {"depth_scale": 0}, "depth_scale is not above 0"),
        (REALSENSE | {"fx": -1.0}, "no camera has"),
    ],
)
def test_files_that_no_lens_has(tmp_path: Path, content: dict[str, Any], told: str) -> None:
    plain(tmp_path, 1000)
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    refuses(told, tmp_path)


def test_files_of_other_programs_are_no_lens(tmp_path: Path) -> None:
    frames(tmp_path, 1000)
    for i in range(len(views())):
        write_colour(tmp_path / f"frame-{i:06d}.color.png", np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "calibration.json").write_text('{"robot": "arm"}')
    assert "a Kinect's lens is assumed" in open_scene(tmp_path).assumed_lens
