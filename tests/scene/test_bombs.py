"""Small files that claim to be vast: refused by a line, before memory or time is spent on them."""

import os
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from engine.errors import PlgsError
from engine.json_file import read_json_object
from engine.posed.array_file import read_npy, read_npz
from engine.posed.image_header import MOST_PIXELS, check_image_bytes, read_image_header
from engine.scene import open_scene
from engine.scene.formats.photos import Video
from engine.scene.pixels import decode_bytes
from tests.raises_key import raises_key
from tests.scene.refusing import check_scene
from tests.tiny_scene import write_tiny_scene

FIX = "Write it again."


def png(width: int, height: int, kind: int = 2) -> bytes:
    """A whole PNG by its checksums, of that size, with next to no pixels."""
    head = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(b"\0")), (b"IEND", b"")]
    body = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def jpeg(width: int, height: int) -> bytes:
    frame = struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9)
    return b"\xff\xd8\xff\xc0" + frame + b"\xff\xda\0\x02\xff\xd9"


VAST = {"2^31": png(2**31 - 1, 2**31 - 1), "2^30": png(2**15, 2**15), "jpeg": jpeg(65535, 65535)}


@pytest.mark.parametrize("data", VAST.values(), ids=VAST)
def test_images_that_are_too_large_are_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(data)
    with raises_key("image-too-large"):
        read_image_header(path)
    with raises_key("image-too-large"):
        check_image_bytes(data, path)
    with raises_key("image-too-large"):
        decode_bytes(data, path, as_colour=True)


def test_the_largest_real_photos_are_accepted(tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(png(14204, 10652))  # of a medium format camera
    assert read_image_header(tmp_path / "image.png").size == (14204, 10652) and 14204 * 10652 <= MOST_PIXELS


JPEG_2000 = bytes.fromhex("0000000c6a5020200d0a870a00000014667479706a703220") + bytes(60)


@pytest.mark.parametrize(
    "data",
    [JPEG_2000, b"\xff\x4f\xff\x51" + bytes(60), b"II*\0" + bytes(60), b"BM" + bytes(60), b"v/1\x01" + bytes(60),
     b"RIFF\0\0\0\0WEBPVP8 " + bytes(60), b"P6 1 1 255\n\0\0\0", b"GIF89a" + bytes(60)],
    ids=["jp2", "j2k", "tiff", "bmp", "exr", "webp", "ppm", "gif"],
)  # fmt: skip
def test_only_png_and_jpeg_files_are_decoded(tmp_path: Path, data: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with raises_key("not-png-or-jpeg"):
        decode_bytes(data, tmp_path / "image.png", as_colour=True)


PLAYLISTS = [b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n", b"ffconcat version 1.0\nfile '/etc/passwd'\n"]


@pytest.mark.parametrize("text", PLAYLISTS)
def test_a_playlist_file_is_not_opened_as_a_video(tmp_path: Path, text: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: pytest.fail("it was opened"))
    (tmp_path / "rgb.mp4").write_bytes(text)
    with raises_key("not-video"):
        Video(tmp_path / "rgb.mp4").frame(0)


def npy(header: str, body: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body


def packed(path: Path, **arrays: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data)
    return path


def test_arrays_that_would_unpack_to_too_much_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "points.npz"
    np.savez_compressed(path, xyz=np.zeros((30_000_000, 3), np.float32))  # 350 kB on the disk, 360 MB in memory
    assert path.stat().st_size < 1 << 20
    with raises_key("array-too-large 360 268"):
        read_npz(path, FIX)
    assert read_npz(path, FIX, names=()) == {}


BAD_HEADERS = {
    "vast": "{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776, 3), }",
    "negative": "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "not closed": "{'descr': '<f4', 'fortran_order': False, 'shape': (((((",
    "deep": "(" * 110,
    "no dtype": "{'descr': 'nonsense', 'fortran_order': False, 'shape': (1,), }",
    "empty": "",
}


@pytest.mark.parametrize("header", BAD_HEADERS.values(), ids=BAD_HEADERS)
def test_array_headers_that_claim_missing_data_are_refused(tmp_path: Path, header: str) -> None:
    (tmp_path / "depth.npy").write_bytes(npy(header, bytes(12)))
    packed(tmp_path / "points.npz", xyz=npy(header, bytes(12)))
    for refuse in (lambda: read_npy(tmp_path / "depth.npy", FIX), lambda: read_npz(tmp_path / "points.npz", FIX)):
        with pytest.raises(PlgsError) as refused:
            refuse()
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("damage", ["cut off", "rotten", "no zip", "empty"])
def test_a_corrupt_array_file_gives_a_one_line_error(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "points.npz"
    np.savez_compressed(path, xyz=np.random.default_rng(0).random((100, 3)))
    data = path.read_bytes()
    spoilt = {"cut off": data[:-40], "rotten": data[:60] + b"\xff" * 20 + data[80:], "no zip": b"PK", "empty": b""}
    path.write_bytes(spoilt[damage])
    with raises_key("array-unreadable"):
        read_npz(path, FIX)


def test_a_huge_json_file_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "panoptic.json").open("wb") as file:
        file.truncate(1 << 40)
    for content in (None, b'{"a":' + b"[" * 200_000, b'{"a":' * 200_000):
        if content is not None:
            (tmp_path / "panoptic.json").write_bytes(content)
        with pytest.raises(PlgsError):
            read_json_object(tmp_path / "panoptic.json")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")
@pytest.mark.parametrize(
    "name",
    ["color/0001.png", "depth/0001.png", "panoptic/0001.png", "pose/0001.txt", "panoptic.json", "splits.json",
     "intrinsic/intrinsic_color.txt"],
)  # fmt: skip
def test_a_fifo_in_a_scene_does_not_block_its_reading(tmp_path: Path, name: str) -> None:
    scene = write_tiny_scene(tmp_path, frames=3, size=(16, 12))
    (scene / name).unlink(missing_ok=True)
    os.mkfifo(scene / name)
    try:
        check_scene(open_scene(scene))
    except PlgsError as error:
        assert "\n" not in str(error)
