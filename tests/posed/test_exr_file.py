"""OpenEXR files: one pixel that stands in for a large picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR

from engine.posed.exr_header import one_pixel_of, read_exr_header
from engine.scene.exr_file import read_channels


def test_one_pixel_has_all_channels_and_texts(tmp_path: Path) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "cryptomatte/1/name": "Instance"}
    kinds = {"PLGS.Depth.V": np.float32, "PLGS.Combined.R": np.float16, "CryptoInstance00.r": np.float32}
    channels = {name: np.ones((5, 7), kind) for name, kind in kinds.items()}
    OpenEXR.File(header, channels).write(str(tmp_path / "large.exr"))
    (tmp_path / "one.exr").write_bytes(one_pixel_of(tmp_path / "large.exr"))
    large, one = read_exr_header(tmp_path / "large.exr"), read_exr_header(tmp_path / "one.exr")
    assert one.size == (1, 1) and one.channels == large.channels and one.texts == large.texts
    assert [each.item() for each in read_channels(tmp_path / "one.exr", one, list(kinds))] == [0.0, 0.0, 0.0]
