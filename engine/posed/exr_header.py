"""Headers of OpenEXR files, read with the standard library alone: Blender's Python has no OpenEXR."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..gates import open_plain
from .frames import Size
from .limits import LARGEST_PIXELS

_MAGIC = b"\x76\x2f\x31\x01"
_HEADER_SIZES = (2**18, 2**26)
"""Bytes of a header that are read at first, and at most. Cryptomatte's names of thousands of objects take megabytes."""
_MOST_NUMBERS = 2**30
"""The largest number of values in all channels of all parts, as the library reads them all."""
_MOST_PARTS = 1024
_TILED, _DEEP, _PARTS = 0x200, 0x800, 0x1000
"""Flags of the version."""
_HALF = 1
"""The kind of a channel of half floats."""
_FIX = "Write this file again."


@dataclass(frozen=True)
class ExrHeader:
    """The header of a file's first part.

    ``size`` is (width, height) of the whole picture, ``first`` the first stored pixel (x, y). ``texts`` are attributes
    whose names have a slash, such as Cryptomatte's. ``numbers`` counts the numbers in all parts.
    """

    size: Size
    first: tuple[int, int]
    channels: tuple[str, ...]
    texts: dict[str, str]
    numbers: int = 0


def read_exr_header(path: Path) -> ExrHeader:
    """The header of a file; all parts are checked. Raises PlgsError."""
    parts = _parts_of(path)
    try:
        found = parts[0]
        left, top, right, bottom = struct.unpack("<4i", found["displayWindow"])
        x, y, *_ = struct.unpack("<4i", found["dataWindow"])
        channels = _channel_names(found["channels"])
        texts = {name: value.decode("utf-8", "replace") for name, value in found.items() if name.find("/") > 0}
        stored = [(*_stored_size(part), len(_channel_names(part["channels"]))) for part in parts]
    except (KeyError, ValueError, IndexError, struct.error) as error:
        raise PlgsError("the OpenEXR header is cut off or makes no sense", path, _FIX) from error
    size = (right - left + 1, bottom - top + 1)
    for width, height in (size, *(one[:2] for one in stored)):
        if min(width, height) < 1 or width * height > LARGEST_PIXELS:
            raise PlgsError(f"{width}x{height} is not the size of a picture", path, _FIX)
    numbers = sum(width * height * max(1, count) for width, height, count in stored)
    if numbers > _MOST_NUMBERS:
        count = sum(one[2] for one in stored)
        raise PlgsError(f"{count} channels are too many to read", path, "Write only the masks' channels.")
    return ExrHeader(size, (x - left, y - top), channels, texts, numbers)


def _parts_of(path: Path) -> list[dict[str, bytes]]:
    """The attributes of each part. Raises PlgsError."""
    try:
        with open_plain(path) as file:
            start, size = file.read(8), os.fstat(file.fileno()).st_size
            if not start.startswith(_MAGIC) or len(start) < 8:
                raise PlgsError("this is not an OpenEXR file", path, _FIX)
            flags = int.from_bytes(start[4:], "little")
            if flags & _DEEP:
                raise PlgsError("deep OpenEXR files are not read", path, "Write a flat picture.")
            for most in _HEADER_SIZES:
                file.seek(8)
                data = file.read(min(most, size))
                with suppress(ValueError, IndexError, struct.error):
                    return _parts(data) if flags & _PARTS else [_attributes(data, 0)[0]]
    except OSError as error:
        raise PlgsError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    except MemoryError as error:
        raise PlgsError("no memory is left for the OpenEXR file", path, "Close other programs.") from error
    raise PlgsError("the OpenEXR header is cut off or makes no sense", path, _FIX)


def _parts(data: bytes) -> list[dict[str, bytes]]:
    """The attributes of each part; an empty header ends them. Raises ValueError, IndexError or struct.error."""
    parts, position = list[dict[str, bytes]](), 0
    while data[position] != 0 and len(parts) <= _MOST_PARTS:
        found, position = _attributes(data, position)
        parts.append(found)
    if not 0 < len(parts) <= _MOST_PARTS:
        raise ValueError(f"{len(parts)} parts")
    return parts


def _stored_size(part: Mapping[str, bytes]) -> Size:
    """Raises KeyError, struct.error."""
    x, y, x_end, y_end = struct.unpack("<4i", part["dataWindow"])
    return x_end - x + 1, y_end - y + 1


def _attributes(data: bytes, position: int) -> tuple[dict[str, bytes], int]:
    """The attributes of a header as stored, and the position of the next header.

    Raises ValueError, IndexError or struct.error when it is cut off.
    """
    found = {}
    while data[position] != 0:
        name_end, start, end = _attribute(data, position)
        found[data[position:name_end].decode("utf-8", "replace")] = data[start:end]
        position = end
    return found, position + 1


def _attribute(data: bytes, position: int) -> tuple[int, int, int]:
    """Where the name of the attribute at a position ends, and where its value begins and ends."""
    name_end = data.index(b"\0", position)
    kind_end = data.index(b"\0", name_end + 1)
    (length,) = struct.unpack_from("<i", data, kind_end + 1)
    start = kind_end + 5
    if length < 0 or start + length >= len(data):
        raise ValueError("cut off")
    return name_end, start, start + length


def one_pixel_of(path: Path) -> bytes:
    """A file with one black pixel that has the channels and texts of another one. Raises PlgsError, also for a file of
    several parts or of tiles, which are not ours.
    """
    parts = _parts_of(path)
    black = {"dataWindow": bytes(16), "displayWindow": bytes(16), "compression": bytes(1)}
    with open_plain(path) as file:
        data = file.read(_HEADER_SIZES[1])
    if int.from_bytes(data[4:8], "little") & (_PARTS | _TILED):
        raise PlgsError("the passes have several parts, or tiles", path, _FIX)
    header, position = data[:8], 8
    while data[position] != 0:
        name_end, start, end = _attribute(data, position)
        value = black.get(data[position:name_end].decode("utf-8", "replace"), data[start:end])
        header += data[position : start - 4] + struct.pack("<i", len(value)) + value
        position = end
    width = sum(2 if kind == _HALF else 4 for _, kind in _channels(parts[0]["channels"]))
    line = struct.pack("<Qii", len(header) + 9, 0, width) + bytes(width)
    return header + b"\0" + line


def _channel_names(data: bytes) -> tuple[str, ...]:
    return tuple(name for name, _ in _channels(data))


def _channels(data: bytes) -> Iterator[tuple[str, int]]:
    """Names and kinds of channels."""
    position = 0
    while data[position] != 0:
        end = data.index(b"\0", position)
        yield data[position:end].decode("utf-8", "replace"), data[end + 1]
        position = end + 17
