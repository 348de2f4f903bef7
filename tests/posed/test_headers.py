"""Headers of OpenEXR files, PNGs and JPEGs, and files of splats."""

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from engine.errors import PlgsError
from engine.passes.ply import columns_of, write_ply_table
from engine.posed.exr_header import one_pixel_of, read_exr_header
from engine.posed.image_header import check_image_file, read_image_header
from engine.posed.ply import read_gaussians
from tests.raises_key import raises_key

WINDOW = b"dataWindow\0box2i\0" + struct.pack("<5i", 16, 0, 0, 6, 4)


def test_a_one_pixel_copy_of_an_exr_keeps_all_channels_and_texts(tmp_path: Path) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "cryptomatte/1/name": "Instance"}
    kinds = {"PLGS.Depth.V": np.float32, "PLGS.Combined.R": np.float16, "CryptoInstance00.r": np.float32}
    channels = {name: np.ones((5, 7), kind) for name, kind in kinds.items()}
    OpenEXR.File(header, channels).write(str(tmp_path / "large.exr"))
    (tmp_path / "one.exr").write_bytes(one_pixel_of(tmp_path / "large.exr"))
    large, one = read_exr_header(tmp_path / "large.exr"), read_exr_header(tmp_path / "one.exr")
    assert one.size == (1, 1) and one.channels == large.channels and one.attributes.keys() == large.attributes.keys()
    with OpenEXR.File(str(tmp_path / "one.exr"), separate_channels=True) as file:
        assert [file.channels()[name].pixels.item() for name in kinds] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda data: data[:90], "exr-header"),
        (lambda data: data[:5] + b"\x08" + data[6:], "deep-exr"),
        (lambda data: data[:5] + b"\x10" + data[6:], "deep-exr"),
        (lambda data: data.replace(WINDOW, WINDOW[:-8] + struct.pack("<2i", 2**20, 2**20)), "bad-size"),
    ],
)
def test_a_picture_with_a_bad_header_is_refused(tmp_path: Path, change: Callable[[bytes], bytes], told: str) -> None:
    OpenEXR.File({}, {"Z": np.ones((5, 7), np.float32)}).write(str(tmp_path / "a.exr"))
    (tmp_path / "a.exr").write_bytes(change((tmp_path / "a.exr").read_bytes()))
    with raises_key(told):
        read_exr_header(tmp_path / "a.exr")


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(
    ("suffix", "kind", "settings"),
    [(".png", np.uint8, []), (".png", np.uint16, []), (".jpg", np.uint8, []),
     (".jpg", np.uint8, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])],
)  # fmt: skip
def test_image_headers_are_read(tmp_path: Path, suffix: str, kind: type, settings: list[int], channels: int) -> None:
    path = tmp_path / f"image{suffix}"
    channels = min(channels, 3) if suffix == ".jpg" else channels
    cv2.imwrite(str(path), np.zeros((5, 70, channels), kind), settings)
    header = read_image_header(path)
    assert header.size == (70, 5) and header.format == ("png" if suffix == ".png" else "jpeg")
    assert (header.bit_depth, header.channels) == (8 * kind().itemsize, channels)
    check_image_file(path)


@pytest.fixture(params=["png", "jpg"])
def image(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"image.{request.param}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    return path


@pytest.mark.parametrize("share", [0.001, 0.01, 0.3, 0.9, 0.999])
def test_a_cut_off_image_is_found_without_decoding_it(image: Path, share: float) -> None:
    data = image.read_bytes()
    image.write_bytes(data[: max(3, int(len(data) * share))])
    with pytest.raises(PlgsError):
        read_image_header(image)
    with pytest.raises(PlgsError):
        check_image_file(image)


def test_the_end_of_a_jpeg_is_found(tmp_path: Path) -> None:
    """What a camera appends is harmless, and the end of a thumbnail is another."""
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    data = path.read_bytes()
    path.write_bytes(data + b"trailer" * 1000)
    assert read_image_header(path).size == (64, 48)
    metadata = b"\xff\xe1" + (2 + 6).to_bytes(2, "big") + b"\xff\xd8..\xff\xd9"
    path.write_bytes(data[:2] + metadata + data[2:-600])
    with raises_key("image-cut-off"):
        read_image_header(path)


COUNT = 6


@pytest.fixture
def original(tmp_path: Path) -> bytes:
    random = np.random.default_rng(0).normal(size=(COUNT, 14)).astype(np.float32)
    columns = columns_of("x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3", random)
    write_ply_table(tmp_path / "splats.ply", {**columns, "class_id": np.arange(COUNT, dtype=np.int32)})
    return (tmp_path / "splats.ply").read_bytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
def test_splats_with_impossible_positions_are_left_out(original: bytes, tmp_path: Path, value: float) -> None:
    path = tmp_path / "nowhere.ply"
    start = original.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(original[:start] + np.float32(value).tobytes() + original[start + 4 :])
    assert read_gaussians(path)["class_id"].tolist() == [1, 2, 3, 4, 5]


def test_a_ply_with_a_column_twice_is_refused(original: bytes, tmp_path: Path) -> None:
    path = tmp_path / "twice.ply"
    path.write_bytes(original.replace(b"property float y", b"property float x"))
    with raises_key("no-splats"):
        read_gaussians(path)


def test_a_splat_file_larger_than_any_lift_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "holes.ply"
    with path.open("wb") as file:
        file.truncate(5 << 30)
    with raises_key("unreadable"):
        read_gaussians(path)
