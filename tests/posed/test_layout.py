"""Files of a scene, what they may claim, and the split."""

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.job.system import MainMemory
from engine.posed import layout
from engine.posed.classes import Category, ClassLabel
from engine.posed.frames import Camera
from engine.posed.layout import check_camera, file_inside, natural_order, read_file, same_shape
from engine.posed.plain_folders import default_split
from engine.scene import open_scene
from engine.scene.depth import depth_check
from engine.scene.formats.colmap_model import _binary_points, _text_points
from engine.scene.formats.lens import Distortion, undistorted
from engine.scene.formats.nerfstudio import read_ply_points
from engine.scene.formats.photos import Video
from engine.scene.formats.scannetpp import _find_blocks
from tests.raises_key import raises_key
from tests.scene.refusing import refuses
from tests.tiny_scene import write_tiny_scene


def test_frames_come_in_natural_order() -> None:
    names = ["10", "9", "0_0010", "0_0009", "frame2", "frame10", "frame-000001.color"]
    ordered = ["0_0009", "0_0010", "9", "10", "frame2", "frame10", "frame-000001.color"]
    assert sorted(names, key=natural_order) == ordered


def test_scannets_slightly_different_aspect_ratio_counts_as_the_same() -> None:
    assert same_shape((1296, 968), (640, 480))
    assert not same_shape((640, 480), (640, 360))
    assert not same_shape((640, 480), (480, 640))


@pytest.mark.parametrize(
    "name", ["../a.png", "a/../../b.png", "/a.png", "\\a.png", "C:a.png", "\\\\host\\a.png", "a\0.png", "", "."]
)
def test_file_names_that_leave_the_scene_folder_are_refused(tmp_path: Path, name: str) -> None:
    with raises_key("leaves-folder"):
        file_inside(tmp_path, name, tmp_path / "table.json")
    assert file_inside(tmp_path, "sub/..a.png", tmp_path / "table.json") == tmp_path / "sub" / "..a.png"


def sparse(path: Path, head: bytes, size: int) -> Path:
    """A file that begins with ``head`` and goes on with holes, which take no room on a disk."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(size)
    return path


def ply(count: int, form: str = "ascii", kind: str = "float") -> bytes:
    fields = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    return f"ply\nformat {form} 1.0\nelement vertex {count}\n{fields}end_header\n".encode()


@pytest.mark.parametrize(
    ("read", "content", "told"),
    [
        (_text_points, b"\n" * 2_000_000, "too-many 1000000"),
        (read_ply_points, ply(60_000_000) + b"\n" * 8_000_000, "cut-off"),
        (read_ply_points, ply(1_100_000) + b"\n" * 8_000_000, "too-many 1000000"),
        (read_ply_points, ply(600_000) + b"\n" * 8_000_000, "ply-not-numbers"),
        (_find_blocks, struct.pack("<IB", 1, 0) * 600_000, "too-many 524288"),
        (lambda path: Video(path).size(), struct.pack(">I4s", 8, b"ftyp") + struct.pack(">I4s", 8, b"free") * 200_000,
         "video-unreadable"),
        (_binary_points, (struct.pack("<Q", 40_000_000), 1 << 31), "unreadable"),
        (_binary_points, (struct.pack("<Q", 1 << 62), 1000), "cut-off"),
        (_binary_points, (struct.pack("<Q", 5_000_000), 51 * 5_000_000 + 8), "too-many 4000000"),
    ],
)  # fmt: skip
def test_files_that_claim_impossible_counts_are_refused(
    tmp_path: Path, read: Callable[[Path], object], content: bytes | tuple[bytes, int], told: str
) -> None:
    path = tmp_path / "file"
    path.write_bytes(content) if isinstance(content, bytes) else sparse(path, *content)
    with raises_key(told):
        read(path)


@pytest.mark.parametrize("size", [(6500, 2), (2, 6500), (3, 3), (640, 16)])
def test_impossible_picture_sizes_are_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    scene = write_tiny_scene(tmp_path, frames=3)
    for path in (scene / "color").iterdir():
        cv2.imwrite(str(path), np.zeros((size[1], size[0], 3), np.uint8))
    (scene / "intrinsic" / "intrinsic_color.txt").write_text("4 0 1 0\n0 4 1 0\n0 0 1 0\n0 0 0 1\n")
    for path in (scene / "depth").iterdir():
        cv2.imwrite(str(path), np.full((size[1], size[0]), 1000, np.uint16))
    refuses("impossible-size", scene)


@pytest.mark.parametrize("focal", [1e299, 1e-30])
def test_impossible_focal_lengths_are_refused(tmp_path: Path, focal: float) -> None:
    scene = write_tiny_scene(tmp_path, frames=3)
    (scene / "intrinsic" / "intrinsic_color.txt").write_text(f"{focal} 0 8 0\n0 {focal} 6 0\n0 0 1 0\n0 0 0 1\n")
    refuses("focal-length", scene)


@pytest.mark.parametrize("metres", [1e-30, 1e6, 1e38])
def test_depth_beyond_the_range_of_any_sensor_is_refused(tmp_path: Path, metres: float) -> None:
    with raises_key("depth-far 0001"):
        depth_check("0001", tmp_path)(np.full((12, 16), metres, np.float32))


def test_estimated_depth_has_the_same_limits_as_measured_depth(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path, frames=3)
    maps = tmp_path / "maps"
    maps.mkdir()
    for path in (scene / "color").iterdir():
        np.save(maps / f"{path.stem}.npy", np.full((1, 5000), 2.0, np.float32))
    with raises_key("impossible-size 0000 5000x1"):
        open_scene(scene, depth=maps).frames[0].depth()


@pytest.mark.parametrize("lens", [Distortion((1e20,)), Distortion((1e10,), is_fisheye=True)])
def test_a_lens_so_distorted_that_no_picture_is_left_is_refused(tmp_path: Path, lens: Distortion) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    with raises_key("lens-distorts"):
        undistorted(np.ones((48, 64), np.float32), camera, lens, tmp_path, smooth=False)


def test_class_names_are_cleaned_to_one_printable_line() -> None:
    name = "chair\u202egnp.exe\u2028\x1b[2J\n"
    for one in (ClassLabel(1, name, True), Category(1, name, True, (1, 2, 3))):
        assert one.name.isprintable() and one.name.startswith("chair?gnp.exe")


def test_a_file_larger_than_the_free_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = sparse(tmp_path / "points.bin", struct.pack("<Q", 1_000_000), 51 * 1_000_000 + 8)
    monkeypatch.setattr(layout, "main_memory", lambda: MainMemory(1 << 34, 101_000_000))
    with raises_key("no-memory 0.051 0.1"):
        _binary_points(points)
    monkeypatch.setattr(layout, "main_memory", lambda: MainMemory(1 << 34, 60_000_000))
    with raises_key("no-memory 0.051"):
        read_file(points, 1 << 30)
    head = ply(2_000_000, "binary_little_endian", "uchar")
    with raises_key("no-memory 0.096"):
        read_ply_points(sparse(tmp_path / "points.ply", head, 3 * 2_000_000 + 1000))


def test_a_frame_name_that_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    with raises_key("frame-name 0001?gpj"):
        check_camera("0001\u202egpj", camera, tmp_path / "a.png")


NAMES = tuple(f"{index:03d}" for index in range(20))


def test_every_eighth_frame_from_the_fifth_is_held_out() -> None:
    split = default_split(NAMES)
    assert split.test == ("004", "012") and len(split.train) == 18 and split.warnings == ()
