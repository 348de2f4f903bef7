"""What apps of phones with depth export: Polycam, 3D Scanner App, Stray Scanner."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats import room
from tests.scene.refusing import refuses

LENS, DEPTH = room.Lens().scaled(2), room.Lens()


def depth_and_level(view: room.View, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth in millimetres and its confidence; of the upper rows neither is to be trusted."""
    depth, levels = room.in_steps(room.look(view, DEPTH).depth, 1000), np.full((48, 64), level, np.uint8)
    depth[:5], levels[:5] = 4999, 0
    return depth, levels


def camera_json(view: room.View, lens: room.Lens) -> str:
    """ARKit's world, y up; the camera's x right, y up, z backward are the columns of t."""
    seen = room.y_up(view)
    t = np.stack([seen.right, seen.up, -seen.forward, seen.eye], axis=1)
    entry = {f"t_{row}{column}": float(t[row, column]) for row in range(3) for column in range(4)}
    entry |= {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "width": lens.width, "height": lens.height}
    return json.dumps(entry | {"blur_score": 81.2, "timestamp": 1})


def write_polycam(folder: Path, corrected: bool = True) -> Path:
    """The plain images and cameras are not as good as the corrected ones: here they are grey and elsewhere."""
    keyframes = folder / "keyframes"
    for kind in ("cameras", "corrected_cameras"):
        (keyframes / kind).mkdir(parents=True)
    for i, view in enumerate(room.views()):
        name = str(98765432100 + 7 * i)
        moved = room.View(view.eye + 0.3, view.right, view.up, view.forward)
        for prefix, seen in (("", moved if corrected else view), ("corrected_", view)):
            room.write_colour(keyframes / f"{prefix}images" / f"{name}.png", room.look(seen, LENS).colour)
            (keyframes / f"{prefix}cameras" / f"{name}.json").write_text(camera_json(seen, LENS))
        depth, level = depth_and_level(view, 127)
        room.write_grey(keyframes / "depth" / f"{name}.png", depth)
        room.write_grey(keyframes / "confidence" / f"{name}.png", level)
    if not corrected:
        for kind in ("corrected_cameras", "corrected_images"):
            shutil.rmtree(keyframes / kind)
    return folder


def without_size(folder: Path, kind: str = "corrected_cameras", **other: float) -> None:
    for path in (folder / "keyframes" / kind).iterdir():
        entry = json.loads(path.read_text())
        path.write_text(json.dumps({key: entry[key] for key in entry if key not in ("width", "height")} | other))


@pytest.mark.parametrize("scale", [1, 2])
def test_a_picture_size_missing_from_phone_scans_is_inferred(tmp_path: Path, scale: int) -> None:
    """Newer exports have no width and height in corrected_cameras. Its numbers may be for larger pictures."""
    write_polycam(tmp_path)
    lens = LENS.scaled(scale)
    numbers = {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy}
    without_size(tmp_path, **numbers)
    without_size(tmp_path, "cameras", **numbers, width=128 * scale, height=96 * scale)
    scene = open_scene(tmp_path)
    room.check_on_room(scene)
    assert any("the size of the pictures of 6 cameras" in warning for warning in scene.warnings)


@pytest.mark.parametrize("kept", [3, 1, 0])
def test_polycam_keyframes_that_were_not_optimised_are_reported(tmp_path: Path, kept: int) -> None:
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
    room.check_on_room(scene)


def table(view: room.View) -> dict[str, object]:
    """ARKit's world, y up; the matrices row by row."""
    pose = room.opengl_pose(room.y_up(view))
    intrinsics = [LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1]
    return {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": intrinsics, "motionQuality": 1}


def write_scanner_app(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for i, view in enumerate(room.views()):
        for number in (2 * i, 2 * i + 1):
            depth, level = depth_and_level(view, 2)
            room.write_grey(folder / f"depth_{number:05d}.png", depth)
            room.write_grey(folder / f"conf_{number:05d}.png", level)
            (folder / f"frame_{number:05d}.json").write_text(json.dumps(table(view)))
        room.write_colour(folder / f"frame_{2 * i:05d}.jpg", room.look(view, LENS).colour)
    room.write_colour(folder / "thumb_00000.jpg", np.zeros((8, 8, 3), np.uint8))
    (folder / "info.json").write_text('{"title": "Scan"}')
    return folder


def test_phone_scans_may_lack_depth_or_a_pose(tmp_path: Path) -> None:
    for path in (*write_scanner_app(tmp_path).glob("*.png"), tmp_path / "frame_00004.json"):
        path.unlink()
    scene = open_scene(tmp_path)
    assert len(scene.frames) == len(room.views()) - 1 and not scene.has_depth
    assert any("without a pose is left out: frame_00004" in warning for warning in scene.warnings)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"intrinsics": [LENS.fx, 0, 0, 0, LENS.fy, 0, LENS.cx, LENS.cy, 1]}, "not-camera-matrix"),
        ({"cameraPoseARFrame": np.ravel(room.opengl_pose(room.views()[0]), "F").tolist()}, "pose-last-row"),
        ({"cameraPoseARFrame": [0.0]}, "wrong-type cameraPoseARFrame 16"),
    ],
)
def test_phone_scan_matrices_out_of_order_are_refused(tmp_path: Path, changed: dict[str, object], told: str) -> None:
    write_scanner_app(tmp_path)
    (tmp_path / "frame_00002.json").write_text(json.dumps(table(room.views()[1]) | changed))
    refuses(told, tmp_path)


def test_photos_with_notes_of_another_program_are_still_photos(tmp_path: Path) -> None:
    for path in write_scanner_app(tmp_path).glob("frame_*.json"):
        path.write_text('{"shapes": []}')
    refuses("no-poses", tmp_path)


STRAY_LENS = room.Lens().scaled(4)


def write_stray(folder: Path, older: bool = False, sideways: bool = False) -> Path:
    """The odometry starts with a frame that tracking had lost, and skips a frame of the video. The pictures of a phone
    held upright lie ``sideways``."""
    folder.mkdir(exist_ok=True)
    video = cv2.VideoWriter(
        str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60, (STRAY_LENS.width, STRAY_LENS.height)
    )
    lines = "timestamp, frame, x, y, z, qx, qy, qz, qw\n1.5, 000000, nan, 0, 0, 0, 0, 0, 1\n"
    for i, plain in enumerate([room.views()[0], room.views()[0], *room.views()]):
        view = room.View(plain.eye, -plain.up, plain.right, plain.forward) if sideways else plain
        video.write(np.ascontiguousarray(room.look(view, STRAY_LENS).colour[..., ::-1]))
        if i == 1:
            continue
        depth, level = depth_and_level(view, 1)
        if older:
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / "depth" / f"{i:06d}.npy", depth)
        else:
            room.write_grey(folder / "depth" / f"{i:06d}.png", depth)
        room.write_grey(folder / "confidence" / f"{i:06d}.png", level)
        if i > 1:
            seen = room.y_up(view)
            w, x, y, z = room.quaternion(np.stack([seen.right, -seen.up, seen.forward], axis=1))
            lines += f"{2 + i / 60:.4f}, {i:06d}, " + ", ".join(f"{v:.7f}" for v in (*seen.eye, x, y, z, w)) + "\n"
    video.release()
    (folder / "odometry.csv").write_text(lines)
    rows = [[STRAY_LENS.fx, 0.0, STRAY_LENS.cx], [0.0, STRAY_LENS.fy, STRAY_LENS.cy], [0.0, 0.0, 1.0]]
    (folder / "camera_matrix.csv").write_text("".join(", ".join(map(str, row)) + "\n" for row in rows))
    return folder


def test_empty_columns_of_stray_scanners_csv_are_ignored(tmp_path: Path) -> None:
    write_stray(tmp_path)
    path = tmp_path / "odometry.csv"
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{head}, horizontal_accuracy, heading", *(f"{row}, , " for row in rows)]) + "\n")
    room.check_on_room(open_scene(tmp_path), colour_step=60)


def test_pictures_of_a_phone_scan_may_come_in_any_order(tmp_path: Path) -> None:
    scene = open_scene(write_stray(tmp_path))
    last = scene.frames[5].read_colour(None)
    first = scene.frames[0].read_colour(None)
    assert np.abs(first.astype(int) - last).mean() > 20
    np.testing.assert_array_equal(scene.frames[5].read_colour(None), last)


def test_a_phone_held_upright_still_has_y_up(tmp_path: Path) -> None:
    scene = open_scene(write_stray(tmp_path, sideways=True))
    assert not any("up" in warning for warning in scene.warnings)
    room.check_on_room(scene, colour_step=60)
