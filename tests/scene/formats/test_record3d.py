"""Record3D's .r3d, as nerfstudio's and other readers of it describe it."""

import base64
import json
import struct
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest

from engine.scene import open_scene
from engine.scene.formats.record3d import unpack_lzfse
from tests.raises_key import raises_key
from tests.scene.formats.room import Lens, check_on_room, look, quaternion, views, write_colour, y_up
from tests.scene.refusing import refuses

LENS = Lens(144, 192, 150.0, 150.0, 74.0, 93.0)
DEPTH = Lens(192, 256, 200.0, 200.0, 74.0 * 4 / 3, 93.0 * 4 / 3)
HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def stored(data: bytes) -> bytes:
    """An LZFSE stream of one block that is not compressed: "bvx-", the size, the bytes, and the end "bvx$"."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


class BrokenStream(Exception):
    pass


def unstored(data: bytes) -> bytes:
    if data[:4] != b"bvx-" or not data.endswith(b"bvx$"):
        raise BrokenStream
    return data[8 : 8 + struct.unpack("<I", data[4:8])[0]]


@pytest.fixture(autouse=True)
def lzfse(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real package where it is installed, else one that knows blocks that are not compressed."""
    try:
        import liblzfse  # noqa: F401
    except ImportError:
        monkeypatch.setitem(sys.modules, "liblzfse", SimpleNamespace(decompress=unstored, error=BrokenStream))


def write_r3d(path: Path, poses: list[list[float]] | None = None, **changes: Any) -> Path:
    """Eleven pictures, so that 10.jpg comes after 9.jpg, out of order in the archive."""
    metadata: dict[str, Any] = {"w": LENS.width, "h": LENS.height, "fps": 60, "poses": poses or []}
    metadata["K"] = [LENS.fx, 0, 0, 0, LENS.fy, 0, LENS.cx, LENS.cy, 1]
    with zipfile.ZipFile(path, "w") as archive:
        for i, view in reversed([*enumerate(views(11))]):
            if poses is None:
                seen = y_up(view)
                w, x, y, z = quaternion(np.stack([seen.right, seen.up, -seen.forward], axis=1))
                metadata["poses"].insert(0, [x, y, z, w, *seen.eye])
            depth = look(view, DEPTH).depth.astype("<f4")
            level = np.full(depth.shape, 2, np.uint8)
            depth[0], level[1:3] = np.nan, 0
            png = cv2.imencode(".jpg", look(view, LENS).colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1]
            archive.writestr(f"rgbd/{i}.jpg", png.tobytes())
            archive.writestr(f"rgbd/{i}.depth", stored(depth.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", stored(level.tobytes()))
        archive.writestr("metadata", json.dumps({k: v for k, v in (metadata | changes).items() if v is not None}))
    return path


def test_points_of_a_record3d_scan_lie_on_the_walls(tmp_path: Path) -> None:
    write_r3d(tmp_path / "room.r3d")
    for place in (tmp_path / "room.r3d", tmp_path):
        scene = open_scene(place)
        assert scene.format == "record3d" and [frame.name for frame in scene.frames] == [str(i) for i in range(11)]
        assert not any("turned" in warning for warning in scene.warnings) and scene.fps == 60
        check_on_room(scene, tolerance=0.002, colour_step=60)
        assert not scene.frames[0].depth()[:3].any()


def test_a_record3d_folder_with_a_lens_for_each_frame_is_read(tmp_path: Path) -> None:
    coefficients = [[LENS.fx, LENS.fy, LENS.cx, LENS.cy]] * 11
    write_r3d(tmp_path / "a.r3d", K=[1.0] * 9, perFrameIntrinsicCoeffs=coefficients, dw=DEPTH.width, dh=DEPTH.height)
    with zipfile.ZipFile(tmp_path / "a.r3d") as archive:
        archive.extractall(tmp_path / "scan")
    check_on_room(open_scene(tmp_path / "scan"), tolerance=0.002, colour_step=60)


def write_exr_rgbd(folder: Path) -> Path:
    """The export "EXR + JPG sequence", as nerfstudio's guide has it."""
    (folder / "depth").mkdir(parents=True)
    with zipfile.ZipFile(write_r3d(folder / "a.r3d")) as archive:
        (folder / "metadata.json").write_bytes(archive.read("metadata"))
    (folder / "a.r3d").unlink()
    for i, view in enumerate(views(11)):
        write_colour(folder / "rgb" / f"{i}.jpg", look(view, LENS).colour)
        with OpenEXR.File(HEADER, {"R": look(view, DEPTH).depth.astype(np.float32)}) as file:
            file.write(str(folder / "depth" / f"{i}.exr"))
    return folder


def test_damaged_record3d_exports_of_pictures_and_exrs_are_refused(tmp_path: Path) -> None:
    folder = write_exr_rgbd(tmp_path)
    window = np.zeros(2, np.int32), np.array([192, 256], np.int32)  # one pixel more each way
    with OpenEXR.File(HEADER | {"displayWindow": window}, {"R": np.ones((256, 192), np.float32)}) as file:
        file.write(str(folder / "depth" / "0.exr"))
    with raises_key("exr-part 0.exr"):
        open_scene(folder).frames[0].depth()
    (folder / "metadata.json").write_text("{}")
    refuses("lacks-field metadata", folder)


def test_record3d_depth_says_which_package_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    scene = open_scene(write_r3d(tmp_path / "a.r3d"))
    scene.frames[0].read_colour(None)
    with raises_key("lacks-part"):
        scene.frames[0].depth()


def test_record3d_depth_that_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read from an archive of some bytes; the library would take four gigabytes."""
    asked: list[bytes] = []
    monkeypatch.setitem(sys.modules, "liblzfse", SimpleNamespace(decompress=asked.append, error=BrokenStream))
    with zipfile.ZipFile(write_r3d(tmp_path / "a.r3d")) as archive:
        archive.extractall(tmp_path / "scan")
    bomb = b"bvxn" + struct.pack("<II", 2**32 - 1, 4) + b"bomb" + b"bvx$"
    (tmp_path / "scan" / "rgbd" / "0.depth").write_bytes(bomb)
    with raises_key("file-damaged 0.depth"):
        open_scene(tmp_path / "scan").frames[0].depth()
    assert asked == []


USUAL = base64.b64decode(
    "YnZ4MsASAAAUAIAAAAQAEGgtdRxoDwAQkQAAADLQgAyPAABwCBwCAIcAAAAAHD4Cj8ajAACPAgAAAAAAAAAAAAAAAAAAAAAAAAAAAPC2AAAAAAAAAAAA"
    "AAAAAAAAAADvxG8AvwHwtcDXAu8EwDsBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAACI7GisHh4AAAAAAAAAAAAAA/g/8H8AYnZ4JA=="
)
"""What Apple's library makes of "hello world " 400 times, 4800 bytes."""
ONE, END = USUAL[:-4], USUAL[-4:]


@pytest.mark.parametrize(
    "data", [ONE[:4] + struct.pack("<I", 2**32 - 1) + ONE[8:] + END, ONE * 10_000 + END, b"", b"bvx", USUAL[:11]]
)
def test_record3d_streams_with_wrong_sizes_are_refused_before_unpacking(data: bytes) -> None:
    with pytest.raises(ValueError, match="unpacks to more than|cut off"):
        unpack_lzfse(data, 4800, lambda data: pytest.fail("unpacked"))


def test_record3d_streams_longer_than_they_claim_are_refused() -> None:
    assert unpack_lzfse(USUAL, 4800, lambda _: bytes(4800)) == bytes(4800)
    with pytest.raises(ValueError, match="unpacks to more than"):
        unpack_lzfse(ONE * 2 + END, 4800, lambda _: bytes(9600))
