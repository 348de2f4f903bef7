"""What no camera makes, and counts that no file can hold, are refused by a line that names the frame or the file."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.job.system import MainMemory
from engine.posed import layout
from engine.posed.classes import Category, ClassLabel
from engine.posed.frames import Camera
from engine.posed.layout import check_camera, read_file
from engine.scene import open_scene
from engine.scene.depth import depth_check
from engine.scene.formats.colmap_model import _binary_points, _text_points
from engine.scene.formats.lens import Distortion, undistorted
from engine.scene.formats.nerfstudio import read_ply_points
from engine.scene.formats.photos import Video
from engine.scene.formats.scannetpp import _find_blocks
from tests.scene.refusing import refuses
from tests.tiny_scene import write_tiny_scene


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
        (_text_points, b"\n" * 2_000_000, "more than 1000000 lines"),
        (read_ply_points, ply(60_000_000) + b"\n" * 8_000_000, "cut off"),
        (read_ply_points, ply(1_100_000) + b"\n" * 8_000_000, "more than 1000000 vertices as text"),
        (read_ply_points, ply(600_000) + b"\n" * 8_000_000, "not numbers|cut off"),
        (_find_blocks, struct.pack("<IB", 1, 0) * 600_000, "more than 524288 frames"),
        (lambda path: Video(path).size(), struct.pack(">I4s", 8, b"ftyp") + struct.pack(">I4s", 8, b"free") * 200_000,
         "the video"),
        (_binary_points, (struct.pack("<Q", 40_000_000), 1 << 31), "larger than"),
        (_binary_points, (struct.pack("<Q", 1 << 62), 1000), "cut off"),
        (_binary_points, (struct.pack("<Q", 5_000_000), 51 * 5_000_000 + 8), "more than 4000000 points"),
    ],
)  # fmt: skip
def test_counts_that_no_file_has_are_refused(
    tmp_path: Path, read: Callable[[Path], object], content: bytes | tuple[bytes, int], told: str
) -> None:
    """A file is its bytes, or the bytes that it begins with and its size."""
    path = tmp_path / "file"
    path.write_bytes(content) if isinstance(content, bytes) else sparse(path, *content)
    with pytest.raises(PlgsError, match=told):
        read(path)


@pytest.mark.parametrize("size", [(6500, 2), (2, 6500), (3, 3), (640, 16)])
def test_pictures_that_no_camera_makes(tmp_path: Path, size: tuple[int, int]) -> None:
    scene = write_tiny_scene(tmp_path, frames=3)
    for path in (scene / "color").iterdir():
        cv2.imwrite(str(path), np.zeros((size[1], size[0], 3), np.uint8))
    (scene / "intrinsic" / "intrinsic_color.txt").write_text("4 0 1 0\n0 4 1 0\n0 0 1 0\n0 0 0 1\n")
    for path in (scene / "depth").iterdir():
        cv2.imwrite(str(path), np.full((size[1], size[0]), 1000, np.uint16))
    refuses("the picture of frame .* which no camera makes", scene)


@pytest.mark.parametrize("focal", [1e299, 1e-30])
def test_focal_lengths_that_no_lens_has(tmp_path: Path, focal: float) -> None:
    scene = write_tiny_scene(tmp_path, frames=3)
    (scene / "intrinsic" / "intrinsic_color.txt").write_text(f"{focal} 0 8 0\n0 {focal} 6 0\n0 0 1 0\n0 0 0 1\n")
    refuses("frame .* has focal lengths of", scene)


@pytest.mark.parametrize("metres", [1e-30, 1e6, 1e38])
def test_depth_beyond_any_sensors_range(tmp_path: Path, metres: float) -> None:
    with pytest.raises(PlgsError, match="the largest depth of frame 0001 is .* which no sensor measures"):
        depth_check("0001", tmp_path)(np.full((12, 16), metres, np.float32))


def test_estimated_depth_has_the_same_limits(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path, frames=3)
    maps = tmp_path / "maps"
    maps.mkdir()
    for path in (scene / "color").iterdir():
        np.save(maps / f"{path.stem}.npy", np.ones((1, 5000), np.float32))
    with pytest.raises(PlgsError, match="depth of frame 0000 is 5000x1, which no camera makes"):
        open_scene(scene, depth=maps).frames[0].depth()


@pytest.mark.parametrize(
    "lens", [Distortion("brown", (1e20, 0.0, 0.0, 0.0)), Distortion("fisheye", (1e10, 0.0, 0.0, 0.0))]
)
def test_a_lens_that_leaves_no_picture_is_reported_as_the_fault(tmp_path: Path, lens: Distortion) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    with pytest.raises(PlgsError, match="the lens distorts so much"):
        undistorted(np.ones((48, 64), np.float32), camera, lens, tmp_path, smooth=False)


def test_class_names_are_one_printable_line() -> None:
    name = "chair\u202egnp.exe\u2028\x1b[2J\n"
    for one in (ClassLabel(1, name, True), Category(1, name, True, (1, 2, 3))):
        assert one.name.isprintable() and one.name.startswith("chair?gnp.exe")


def test_what_a_file_becomes_fits_into_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = sparse(tmp_path / "points.bin", struct.pack("<Q", 1_000_000), 51 * 1_000_000 + 8)
    monkeypatch.setattr(layout, "main_memory", lambda: MainMemory(1 << 34, 101_000_000))
    with pytest.raises(PlgsError, match="it takes 0.051 GB of memory, but only 0.1 GB are free"):
        _binary_points(points)
    monkeypatch.setattr(layout, "main_memory", lambda: MainMemory(1 << 34, 60_000_000))
    with pytest.raises(PlgsError, match="it takes 0.051 GB of memory"):
        read_file(points, 1 << 30)
    head = ply(2_000_000, "binary_little_endian", "uchar")
    with pytest.raises(PlgsError, match="it takes 0.096 GB of memory"):
        read_ply_points(sparse(tmp_path / "points.ply", head, 3 * 2_000_000 + 1000))


def test_a_frame_whose_name_cannot_be_shown(tmp_path: Path) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    with pytest.raises(PlgsError, match=r"the name of frame 0001\?gpj cannot be shown as text"):
        check_camera("0001\u202egpj", camera, tmp_path / "a.png")
