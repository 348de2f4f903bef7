from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import PlgsError
from engine.posed.image_header import check_image_file, read_image_header


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(
    ("suffix", "kind", "settings"),
    [(".png", np.uint8, []), (".png", np.uint16, []), (".jpg", np.uint8, []),
     (".jpg", np.uint8, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])],
)  # fmt: skip
def test_a_header_tells_size_depth_and_channels(
    tmp_path: Path, suffix: str, kind: type, settings: list[int], channels: int
) -> None:
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


def test_what_a_camera_appends_to_a_jpeg_is_harmless(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.zeros((48, 64, 3), np.uint8))
    path.write_bytes(path.read_bytes() + b"trailer" * 1000)
    assert read_image_header(path).size == (64, 48)


def test_the_end_of_a_thumbnail_is_not_the_end_of_a_jpeg(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    data = path.read_bytes()
    metadata = b"\xff\xe1" + (2 + 6).to_bytes(2, "big") + b"\xff\xd8..\xff\xd9"
    path.write_bytes(data[:2] + metadata + data[2:-600])
    with pytest.raises(PlgsError, match="cut off"):
        read_image_header(path)


def test_a_missing_image_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(PlgsError, match="cannot be read"):
        read_image_header(tmp_path / "none.png")
