"""Headers of OpenEXR files, read with the standard library alone: Blender's Python has no OpenEXR."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping, Sequence
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
_HALF, _FLOAT = 1, 2
"""Kinds of channels: half floats, and floats of 32 bits."""
_PXR24, _B44, _DWA = {5}, {6, 7}, {8, 9}
"""Compressions that lose bits: of floats, of half floats, and of colours."""
_BARE = {*"rgbaxyzvuw", "red", "green", "blue", "alpha"}
"""Names of channels that leave the layer's name to their part."""
_FIX = "Write this file again."


@dataclass(frozen=True)
class ExrChannel:
    """A channel: the number of its ``part``, its ``name`` there, and its ``first`` stored pixel (x, y) in the picture.

    Whole numbers below ``exact`` are as they were written; ``is_float`` says whether it has floats of 32 bits.
    """

    part: int
    name: str
    first: tuple[int, int]
    is_float: bool
    exact: int


@dataclass(frozen=True)
class ExrHeader:
    """The headers of all parts of a file.

    ``size`` is (width, height) of the whole picture. ``channels`` are known by the layer's name and their own; a part
    is named after its layer. ``texts`` are attributes whose names have a slash, such as Cryptomatte's. ``numbers``
    counts the numbers in all ``parts``, ``views`` are those of a stereo picture in parts.
    """

    size: Size
    channels: Mapping[str, ExrChannel]
    texts: Mapping[str, str]
    numbers: int = 0
    views: tuple[str, ...] = ()
    parts: int = 1


def read_exr_header(path: Path) -> ExrHeader:
    """The header of a file; all parts are checked. Raises PlgsError."""
    parts = _parts_of(path)
    try:
        left, top, right, bottom = struct.unpack("<4i", parts[0]["displayWindow"])
        channels = _named_channels(parts, (left, top))
        stored = [(*_stored_size(part), len([*_channels(part["channels"])])) for part in parts]
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
    views = tuple(dict.fromkeys(_text(part["view"]) for part in parts if "view" in part))
    return ExrHeader(size, channels, _texts(parts), numbers, views, len(parts))


def _named_channels(parts: Sequence[Mapping[str, bytes]], corner: tuple[int, int]) -> dict[str, ExrChannel]:
    """Of several channels of one name, such as those of two views, the first. Raises what `_parts` does, KeyError."""
    found: dict[str, ExrChannel] = {}
    for number, part in enumerate(parts):
        x, y, *_ = struct.unpack("<4i", part["dataWindow"])
        for name, kind in _channels(part["channels"]):
            exact = _exact(kind, name, part["compression"][0])
            channel = ExrChannel(number, name, (x - corner[0], y - corner[1]), kind == _FLOAT, exact)
            is_bare = name.casefold() in _BARE
            if number == 0 or not is_bare:
                found.setdefault(name, channel)
            if is_bare and "name" in part:
                found.setdefault(f"{_text(part['name'])}.{name}", channel)
    return found


def _exact(kind: int, name: str, compression: int) -> int:
    """Whole numbers below this are kept in a channel."""
    if (compression in _DWA and name.rpartition(".")[2] in {"R", "G", "B", "Y"}) or (
        compression in _B44 and kind == _HALF
    ):
        return 0
    if kind == _HALF:
        return 2**11
    return 2**16 if compression in _PXR24 and kind == _FLOAT else 2**32


def _texts(parts: Sequence[Mapping[str, bytes]]) -> dict[str, str]:
    """The texts of all parts. Where a part says something else by a name that was there before, its number is added."""
    found: dict[str, str] = {}
    for number, part in enumerate(parts):
        texts = {name: _text(value) for name, value in part.items() if name.find("/") > 0}
        if any(found.get(name, text) != text for name, text in texts.items()):
            texts = {name.replace("/", f"/{number}.", 1): text for name, text in texts.items()}
        found |= texts
    return found


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace")


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
        found[_text(data[position:name_end])] = data[start:end]
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
        value = black.get(_text(data[position:name_end]), data[start:end])
        header += data[position : start - 4] + struct.pack("<i", len(value)) + value
        position = end
    width = sum(2 if kind == _HALF else 4 for _, kind in _channels(parts[0]["channels"]))
    line = struct.pack("<Qii", len(header) + 9, 0, width) + bytes(width)
    return header + b"\0" + line


def _channels(data: bytes) -> Iterator[tuple[str, int]]:
    """Names and kinds of channels."""
    position = 0
    while data[position] != 0:
        end = data.index(b"\0", position)
        yield _text(data[position:end]), data[end + 1]
        position = end + 17
