"""OpenEXR files: one pixel that stands in for a large picture."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from engine.errors import PlgsError
from engine.posed.exr_header import one_pixel_of, read_exr_header

WINDOW = b"dataWindow\0box2i\0" + struct.pack("<5i", 16, 0, 0, 6, 4)


def test_one_pixel_has_all_channels_and_texts(tmp_path: Path) -> None:
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
        (lambda data: data[:90], "cut off"),
        (lambda data: data[:5] + b"\x08" + data[6:], "deep or of several parts"),
        (lambda data: data[:5] + b"\x10" + data[6:], "deep or of several parts"),
        (
            lambda data: data.replace(WINDOW, WINDOW[:-8] + struct.pack("<2i", 2**20, 2**20)),
            "not the size of a picture",
        ),
    ],
)
def test_a_header_that_makes_no_sense_is_refused(tmp_path: Path, change: Callable[[bytes], bytes], told: str) -> None:
    OpenEXR.File({}, {"Z": np.ones((5, 7), np.float32)}).write(str(tmp_path / "a.exr"))
    (tmp_path / "a.exr").write_bytes(change((tmp_path / "a.exr").read_bytes()))
    with pytest.raises(PlgsError, match=told):
        read_exr_header(tmp_path / "a.exr")
