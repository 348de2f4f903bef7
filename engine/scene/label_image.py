"""Pictures whose grey values are ids."""

from __future__ import annotations

from pathlib import Path

from .frame import SceneError, Size
from .image_header import read_image_header


def check_label_header(path: Path) -> Size:
    """The size of a label image (width, height). Raises SceneError unless it has one channel of 8 or 16 bits."""
    header = read_image_header(path)
    if header.format != "png" or header.channels != 1 or header.palette or header.bit_depth < 8:
        raise SceneError(
            "a label image must be a PNG with one channel of 8 or 16 bits, without a palette",
            path,
            "Save the ids themselves as grey values.",
        )
    return header.size
