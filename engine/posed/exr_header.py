"""Headers of single-part OpenEXR files, read with the standard library alone: Blender's Python has no OpenEXR."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError, reading
from ..gates import open_plain
from .frames import Size
from .layout import LARGEST_PIXELS

_MAGIC = b"\x76\x2f\x31\x01"
_HEADER_SIZES = (2**18, 2**26)  # bytes read at first, and at most: Cryptomatte's thousands of names take megabytes
_MOST_NUMBERS = 2**30  # maximum number of values in all channels, as the library reads them all
_TILED, _DEEP, _PARTS = 0x200, 0x800, 0x1000  # flags of the version
_HALF = 1  # the channel type of half floats
_FIX = "Write it again as OpenEXR with one part and scan lines."


@dataclass(frozen=True)
class ExrHeader:
    """The header of an OpenEXR file. ``size`` is the (width, height) of the stored pixels, which may be only a part of
    the picture or more than it. ``channels`` maps a channel's name to its bytes per value; ``start`` is the first eight
    bytes; ``attributes`` maps a name to its type and value as stored."""

    size: Size
    channels: Mapping[str, int]
    start: bytes
    attributes: Mapping[bytes, tuple[bytes, bytes]]

    @property
    def numbers(self) -> int:
        """The number of stored values: pixels times channels."""
        return self.size[0] * self.size[1] * len(self.channels)

    @property
    def is_whole(self) -> bool:
        """Whether the stored pixels are exactly the picture, without crop or overscan."""
        return self.attributes[b"dataWindow"] == self.attributes[b"displayWindow"]


def read_exr_header(path: Path) -> ExrHeader:
    """Read the header of an OpenEXR file. Raises PlgsError for other files, damaged ones, and ones of several parts."""
    start, attributes = _attributes_of(path)
    try:
        (left, top, right, bottom), _ = (
            struct.unpack("<4i", attributes[name][1]) for name in (b"dataWindow", b"displayWindow")
        )
        channels = _channels(attributes[b"channels"][1])
    except (KeyError, ValueError, IndexError, struct.error) as error:
        raise PlgsError("exr-header", "the OpenEXR header is cut off or invalid", path, _FIX) from error
    width, height = right - left + 1, bottom - top + 1
    if min(width, height) < 1 or width * height > LARGEST_PIXELS:
        raise PlgsError("bad-size", f"{width}x{height} is not a valid picture size", path, _FIX)
    header = ExrHeader((width, height), channels, start, attributes)
    if header.numbers > _MOST_NUMBERS:
        raise PlgsError("channels", f"{len(channels)} channels are too many to read", path, _FIX)
    return header


def one_pixel_of(path: Path) -> bytes:
    """Return an EXR of one black pixel with the channels and attributes of ``path``. Raises PlgsError for others."""
    header = read_exr_header(path)
    if int.from_bytes(header.start[4:], "little") & _TILED:
        raise PlgsError("exr-tiles", "this OpenEXR file has tiles, which are not read", path, _FIX)
    black = {b"dataWindow": bytes(16), b"displayWindow": bytes(16), b"compression": bytes(1)}  # one pixel, uncompressed
    content = header.start
    for name, (kind, value) in header.attributes.items():
        value = black.get(name, value)
        content += name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value
    width = sum(header.channels.values())  # bytes of a pixel
    return content + b"\0" + struct.pack("<Qii", len(content) + 9, 0, width) + bytes(width)  # the line's place, y, size


def _attributes_of(path: Path) -> tuple[bytes, dict[bytes, tuple[bytes, bytes]]]:
    """Read a file's first eight bytes, and its attributes (type and value by name). Raises PlgsError for damage."""
    try:
        with reading(path), open_plain(path) as file:
            start, size = file.read(8), os.fstat(file.fileno()).st_size
            if not start.startswith(_MAGIC) or len(start) < 8:
                raise PlgsError("not-exr", "this is not an OpenEXR file", path, _FIX)
            if int.from_bytes(start[4:], "little") & (_DEEP | _PARTS):
                raise PlgsError("deep-exr", "deep and multi-part OpenEXR files are not read", path, _FIX)
            for most in _HEADER_SIZES:
                file.seek(8)
                data = file.read(min(most, size))
                with suppress(ValueError, IndexError, struct.error):  # cut off: read more
                    return start, _attributes(data)
    except MemoryError as error:
        raise PlgsError("no-memory", "no memory is left for the OpenEXR file", path, "Close other programs.") from error
    raise PlgsError("exr-header", "the OpenEXR header is cut off or invalid", path, _FIX)


def _attributes(data: bytes) -> dict[bytes, tuple[bytes, bytes]]:
    """Parse the attributes of an EXR. Raises ValueError, IndexError or struct.error if the header is truncated."""
    found, position = {}, 0
    while data[position] != 0:
        name_end = data.index(b"\0", position)
        kind_end = data.index(b"\0", name_end + 1)
        (length,) = struct.unpack_from("<i", data, kind_end + 1)
        start, end = kind_end + 5, kind_end + 5 + length  # after a zero and the length
        if length < 0 or end >= len(data):
            raise ValueError("cut off")
        found[data[position:name_end]] = data[name_end + 1 : kind_end], data[start:end]
        position = end
    return found


def _channels(data: bytes) -> dict[str, int]:
    """Parse the channel list: the bytes per value of each channel, by name. Raises ValueError, IndexError."""
    found, position = {}, 0
    while data[position] != 0:
        end = data.index(b"\0", position)
        found[data[position:end].decode("utf-8", "replace")] = 2 if data[end + 1] == _HALF else 4
        position = end + 17  # a zero, the type, four bytes of flags, two samplings
    return found
