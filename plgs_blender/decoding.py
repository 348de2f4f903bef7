"""Reading a scene's image files with Blender's own decoder: its Python has no OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.scene import SceneError, Size
from ..engine.scene.image_header import read_image_header
from ..engine.scene.pixels import decoding_with

Pixels = TypeVar("Pixels")


def read_here(read: Callable[[Size | None], Pixels]) -> Pixels | None:
    """What a frame's reader gives, with images decoded by Blender; None where the reader needs more than that and
    numpy: OpenCV for videos and lenses that bend, h5py. Raises SceneError.
    """
    with decoding_with(decode_in_blender):
        try:
            return read(None)
        except ImportError:
            return None


def decode_in_blender(path: Path, as_colour: bool) -> NDArray[Any]:
    """`engine.scene.pixels.decode` by Blender: the same numbers, of PNGs of 8 and 16 bits and of 8-bit JPEGs.

    Raises SceneError.
    """
    header = read_image_header(path)
    image = bpy.data.images.load(str(path), check_existing=False)
    try:
        # As data: neither converted to linear light nor multiplied by alpha.
        image.colorspace_settings.is_data, image.alpha_mode = True, "CHANNEL_PACKED"
        width, height = image.size
        if (width, height) != header.size:
            raise SceneError("the image cannot be decoded", path, "Write this file again.")
        values = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(values)
        deep = image.is_float
    finally:
        bpy.data.images.remove(image)
    pixels = values.reshape(height, width, -1)[::-1]  # Blender's first row is the lowest
    whole = np.rint(pixels * (65535.0 if deep else 255.0)).astype(np.uint16 if deep else np.uint8)
    if as_colour:
        colour = (whole >> 8).astype(np.uint8) if deep else whole
        return np.ascontiguousarray(colour[..., :3])
    if header.channels <= 2 and not header.palette:
        return np.ascontiguousarray(whole[..., 0])
    return np.ascontiguousarray(whole[..., : max(3, header.channels)])
