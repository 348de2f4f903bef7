"""OpenEXR files: what their headers say, by the standard library alone, and their channels, through OpenEXR."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...gates import open_plain
from ..frame import SceneError, Size
from .label_map import LARGEST_PIXELS

_MAGIC = b"\x76\x2f\x31\x01"
_LARGEST_HEADER = 2**26
_MOST_NUMBERS = 2**30
_FIX = "Write this file again."


@dataclass(frozen=True)
class ExrHeader:
    """``size`` of the whole picture, the first pixel (x, y) that is stored, names of channels, texts of attributes."""

    size: Size
    first: tuple[int, int]
    channels: tuple[str, ...]
    texts: dict[str, str]


def read_exr_header(path: Path) -> ExrHeader:
    """The header of the first part. Raises SceneError."""
    try:
        with open_plain(path) as file:
            data = file.read(8)
            if not data.startswith(_MAGIC) or len(data) < 8:
                raise SceneError("this is no OpenEXR file", path, _FIX)
            data = file.read(_LARGEST_HEADER)
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    try:
        found = _attributes(data)
        left, top, right, bottom = struct.unpack("<4i", found["displayWindow"])
        x, y, x_end, y_end = struct.unpack("<4i", found["dataWindow"])
        channels = _channel_names(found["channels"])
        texts = {name: value.decode("utf-8", "replace") for name, value in found.items() if name.find("/") > 0}
    except (KeyError, ValueError, IndexError, struct.error) as error:
        raise SceneError("the OpenEXR header is cut off or makes no sense", path, _FIX) from error
    size, stored = (right - left + 1, bottom - top + 1), (x_end - x + 1, y_end - y + 1)
    if min(*size, *stored) < 1 or size[0] * size[1] > LARGEST_PIXELS or stored[0] * stored[1] > LARGEST_PIXELS:
        raise SceneError(f"{size[0]}x{size[1]} is no size of a mask", path, _FIX)
    if stored[0] * stored[1] * max(1, len(channels)) > _MOST_NUMBERS:
        raise SceneError(f"{len(channels)} channels are too many to read", path, "Write the masks' channels alone.")
    return ExrHeader(size, (x - left, y - top), channels, texts)


def _attributes(data: bytes) -> dict[str, bytes]:
    """The values of all attributes as stored. Raises ValueError or struct.error where the header is cut off."""
    found, position = {}, 0
    while data[position] != 0:
        name_end = data.index(b"\0", position)
        kind_end = data.index(b"\0", name_end + 1)
        (length,) = struct.unpack_from("<i", data, kind_end + 1)
        start = kind_end + 5
        if length < 0 or start + length >= len(data):
            raise ValueError("cut off")
        found[data[position:name_end].decode("utf-8", "replace")] = data[start : start + length]
        position = start + length
    return found


def _channel_names(data: bytes) -> tuple[str, ...]:
    names, position = [], 0
    while data[position] != 0:
        end = data.index(b"\0", position)
        names.append(data[position:end].decode("utf-8", "replace"))
        position = end + 17
    return tuple(names)


def read_channels(path: Path, header: ExrHeader, names: list[str]) -> list[NDArray[np.float32]]:
    """Channels as float32 [H, W] of the whole picture, 0 where nothing is stored. Raises SceneError."""
    try:
        import OpenEXR
    except ImportError as error:
        fix = "Let the engine's Python install it: python -m pip install -r requirements/engine.txt."
        raise SceneError("EXR masks need the package OpenEXR", path, fix) from error
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            stored: dict[str, NDArray[Any]] = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, OSError) as error:
        raise SceneError("the OpenEXR file cannot be read, or is cut off", path, _FIX) from error
    return [placed(stored[name], header) if name in stored else _missing(name, path) for name in names]


def placed(pixels: NDArray[Any], header: ExrHeader) -> NDArray[np.float32]:
    """The stored pixels within the whole picture, where they are not all of it. 32-bit floats stay bit for bit."""
    values = pixels.astype(np.float32)
    if header.first == (0, 0) and values.shape == header.size[::-1]:
        return values
    whole = np.zeros(header.size[::-1], np.float32)
    x, y = header.first
    left, right = max(x, 0), min(x + values.shape[1], header.size[0])
    top, bottom = max(y, 0), min(y + values.shape[0], header.size[1])
    if left < right and top < bottom:
        whole[top:bottom, left:right] = values[top - y : bottom - y, left - x : right - x]
    return whole


def _missing(name: str, path: Path) -> NDArray[np.float32]:
    raise SceneError(f'the channel "{name}" is missing'[:90], path, _FIX)
