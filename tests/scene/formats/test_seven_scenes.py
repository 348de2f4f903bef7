"""7-Scenes as its page describes it, and with files that say the lens; Replica's renderings as NICE-SLAM has them."""

import json
from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats import room
from tests.scene.refusing import refuses

# The Kinect's two lenses for pictures of 160x120, a quarter of the size; the principal point is the integer pixel
# (320, 240) of 640x480.
DEPTH_LENS = room.Lens(160, 120, 585 / 4, 585 / 4, 320.5 / 4, 240.5 / 4)
COLOUR_LENS = room.Lens(160, 120, 525 / 4, 525 / 4, 320.5 / 4, 240.5 / 4)
# Lenses of a sensor whose pictures differ in size.
COLOUR, DEPTH = room.Lens(108, 80, 97.0, 97.5, 54.3, 40.2), room.Lens(64, 48, 58.0, 58.4, 32.4, 24.1)
# Where the colour camera stands as the depth camera sees it, written from the published rotation and translation.
R = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01],
    ]
)
T = np.array([-2.5558943178152542e-02, 1.0109636268061706e-04, 2.0318321729487039e-03])


def depth_view(colour: room.View) -> room.View:
    """The depth camera beside a colour camera: a point x of its own lies at R x + T of the colour camera."""
    axes = np.stack([colour.right, -colour.up, colour.forward], axis=1)
    right, down, forward = (axes @ R).T
    return room.View(colour.eye + axes @ T, right, -down, forward)


def write_seven(folder: Path) -> Path:
    for i, view in enumerate(room.views()):
        beside = depth_view(view)
        base = folder / "seq-01" / f"frame-{i:06d}"
        depth = room.in_steps(room.look(beside, DEPTH_LENS).depth, 1000)
        depth[:3] = 65535
        room.write_colour(base.with_suffix(".color.png"), room.look(view, COLOUR_LENS).colour)
        room.write_grey(base.with_suffix(".depth.png"), depth)
        np.savetxt(base.with_suffix(".pose.txt"), room.opencv_pose(beside), "%.9e")
    return folder


@pytest.mark.parametrize("place", ["", "seq-01"])
def test_raw_7_scenes_depth_is_registered_to_colour(tmp_path: Path, place: str) -> None:
    scene = open_scene(write_seven(tmp_path) / place)
    assert scene.format == "7scenes"
    assert scene.frames[0].name == ("frame-000000" if place else "seq-01_frame-000000")
    # Registered depth takes pixels of another grid: up to 0.7 pixels aside, 2 cm at a slant.
    room.check_on_room(scene, tolerance=0.022, share=0.97)
    depth = scene.frames[0].depth((320, 240))
    assert depth.shape == (240, 320) and depth.max() < 10.0
    # Half a pixel's slant; without registration the median is centimetres.
    assert np.median(np.abs(scene.frames[0].depth() - room.look(room.views()[0], COLOUR_LENS).depth)) < 0.008


def test_registered_7_scenes_depth_is_used_if_it_exists(tmp_path: Path) -> None:
    write_seven(tmp_path)
    for i, view in enumerate(room.views()):
        base = tmp_path / "seq-01" / f"frame-{i:06d}"
        room.write_grey(base.with_suffix(".depth.proj.png"), room.in_steps(room.look(view, COLOUR_LENS).depth, 1000))
        np.savetxt(base.with_suffix(".pose.txt"), room.opencv_pose(view))
    room.check_on_room(open_scene(tmp_path))


@pytest.mark.parametrize("where", ["camera-intrinsics.txt", "scans/camera-intrinsics.txt"])
def test_the_lens_is_read_from_camera_intrinsics_txt(tmp_path: Path, where: str) -> None:
    lens = room.Lens()
    folder = tmp_path / "scans"
    for i, view in enumerate(room.views()):
        picture = room.look(view, lens)
        depth = room.in_steps(picture.depth, 1000)
        depth[:3] = 65535
        base = folder / f"frame-{i:06d}"
        room.write_colour(base.with_suffix(".color.jpg"), picture.colour)
        room.write_grey(base.with_suffix(".depth.png"), depth)
        np.savetxt(base.with_suffix(".pose.txt"), room.opencv_pose(view))
    np.savetxt(tmp_path / where, [[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])  # fmt: skip
    np.savetxt(folder / "frame-000006.pose.txt", np.full((4, 4), np.inf))
    scene = open_scene(folder)
    assert scene.format == "7scenes" and "1 frame without a pose is left out: frame-000006" in scene.warnings
    room.check_on_room(scene, colour_step=60)
    assert not scene.frames[0].depth()[:3].any()


def write_info(folder: Path, place: str = "", name: str = "info.txt", steps: int = 1000, **changed: str) -> Path:
    """BundleFusion's frames and its file about the sensor, whose lines may be ``changed``."""
    for i, view in enumerate(room.views()):
        base = folder / place / f"frame-{i:06d}"
        room.write_colour(base.with_suffix(".color.jpg"), room.look(view, COLOUR).colour)
        room.write_grey(base.with_suffix(".depth.png"), room.in_steps(room.look(view, DEPTH).depth, steps))
        np.savetxt(base.with_suffix(".pose.txt"), room.opencv_pose(view))
    lines = {"m_versionNumber": "4", "m_sensorName": "StructureSensor (calibrated)", "m_depthShift": str(steps)}
    for kind, lens in (("Color", COLOUR), ("Depth", DEPTH)):
        lines |= {f"m_{kind.lower()}Width": str(2 * lens.width), f"m_{kind.lower()}Height": str(2 * lens.height)}
        K = [2 * lens.fx, 0, 2 * lens.cx - 0.5, 0, 0, 2 * lens.fy, 2 * lens.cy - 0.5, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        lines[f"m_calibration{kind}Intrinsic"] = " ".join(map(str, K)) + " "
        lines[f"m_calibration{kind}Extrinsic"] = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 "
    lines |= changed
    (folder / name).write_text("".join(f"{key} = {value}\n" for key, value in lines.items() if value))
    return folder


@pytest.mark.parametrize(
    ("place", "opened", "name", "steps"),
    [("", "", "_info.txt", 4000), ("data", "", "info.txt", 1000), ("data", "data", "info.txt", 500)],
)
def test_both_lenses_are_read_from_info_txt(tmp_path: Path, place: str, opened: str, name: str, steps: int) -> None:
    """BundleFusion, ScanNet's own reader, and 12-Scenes, whose frames lie in data; pictures of half the size."""
    write_info(tmp_path, place, name, steps)
    scene = open_scene(tmp_path / opened)
    lens = scene.frames[0].camera
    assert scene.frames[0].name == "frame-000000" and scene.warnings == ()
    assert [lens.fx, lens.fy, lens.cx, lens.cy] == pytest.approx([COLOUR.fx, COLOUR.fy, COLOUR.cx, COLOUR.cy])
    assert lens.camera_to_world == pytest.approx(room.opencv_pose(room.views()[0]))
    room.check_on_room(scene, tolerance=0.06, share=0.97, colour_step=60)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"m_calibrationColorIntrinsic": ""}, "info-value m_calibrationColorIntrinsic"),
        ({"m_calibrationDepthIntrinsic": "0 " * 16}, "not-camera-matrix"),
        ({"m_calibrationDepthIntrinsic": "1 2 3"}, "info-value m_calibrationDepthIntrinsic 16"),
        ({"m_colorWidth": "many"}, "info-value m_colorWidth"),
        ({"m_depthShift": "0"}, "info-value m_depthShift"),
        ({"m_depthWidth": "260"}, "lenses-differ"),
        ({"m_colorHeight": "170"}, "other-size 216x170"),
    ],
)
def test_a_bad_info_txt_is_refused(tmp_path: Path, changed: dict[str, str], told: str) -> None:
    refuses(told, write_info(tmp_path, **changed))


def test_other_texts_called_info_txt_are_ignored(tmp_path: Path) -> None:
    """Colour and depth that stand apart are told; a text by a person is none."""
    apart = "1 0 0 0.02 0 1 0 0 0 0 1 0 0 0 0 1"
    scene = open_scene(write_info(tmp_path / "apart", m_calibrationColorExtrinsic=apart))
    assert any("stand apart" in warning for warning in scene.warnings)
    write_seven(tmp_path / "text")
    (tmp_path / "text" / "info.txt").write_bytes(b"the Kitchen\xff\n")
    assert any("a Kinect's lens is assumed (525 525" in each for each in open_scene(tmp_path / "text").warnings)


def test_both_lenses_of_intrinsic3d_are_read(tmp_path: Path) -> None:
    write_info(tmp_path, name="unused.txt")
    for name, lens in (("color", COLOUR), ("depth", DEPTH)):
        K = np.diag([lens.fx, lens.fy, 1.0, 1.0])
        K[:2, 2] = lens.cx - 0.5, lens.cy - 0.5
        np.savetxt(tmp_path / f"{name}Intrinsics.txt", K)
    room.check_on_room(open_scene(tmp_path), tolerance=0.06, share=0.97, colour_step=60)


def test_poses_of_lost_frames_with_windows_line_ends_are_read(tmp_path: Path) -> None:
    write_info(tmp_path)
    (tmp_path / "frame-000001.pose.txt").write_text("-1.#INF -1.#INF -1.#INF00 1.#INF\n" * 4)
    assert open_scene(tmp_path).warnings[0] == "1 frame without a pose is left out: frame-000001"


def test_missing_7_scenes_depth_files_are_named(tmp_path: Path) -> None:
    write_seven(tmp_path)
    for path in sorted(tmp_path.rglob("*.depth.png"))[2:]:
        path.unlink()
    refuses("unreadable frame-000002.depth.png", tmp_path)
    (tmp_path / "seq-01" / "frame-000002.depth.pgm").write_bytes(b"P5 160 120 65535\n")
    refuses("depth-pgm frame-000002.depth.pgm", tmp_path)


# 600 600 599.5 339.5 of 1200x680, integer centres, for a tenth of the size; and another lens that sees 90 degrees.
NICE = room.Lens(120, 68, 60.0, 60.0, 60.0, 34.0)
HALF = room.Lens(64, 48, 32.0, 32.0, 32.0, 24.0)


def write_nice(folder: Path, lens: room.Lens = NICE, steps: float = 6553.5) -> Path:
    for i, view in enumerate(room.views()):
        results = folder / "results"
        room.write_pair(results / f"frame{i:06d}.jpg", results / f"depth{i:06d}.png", room.look(view, lens), steps)
    np.savetxt(folder / "traj.txt", [room.opencv_pose(view).ravel() for view in room.views()], "%.9e")
    return folder


def test_the_lens_is_read_from_a_nice_slam_camera_file(tmp_path: Path) -> None:
    lens = room.Lens()
    write_nice(tmp_path / "office0", lens, steps=1000.0)
    camera = {"w": 64, "h": 48, "fx": lens.fx, "fy": lens.fy, "cx": lens.cx - 0.5, "cy": lens.cy - 0.5, "scale": 1000.0}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    room.check_on_room(open_scene(tmp_path / "office0"), colour_step=60)
