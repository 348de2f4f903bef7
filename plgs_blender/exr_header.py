"""Which layers an OpenEXR file has, and its size, read off its first bytes. Plain Python.

Blender says of a damaged file no more than that its image has no size, and nodes then take no layer of it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

from ..engine.gates import open_plain
from ..engine.job import JobError
from ..engine.job.manifest import MAKE_ANEW
from ..engine.job.preview_request import LARGEST_SIDE

_MAGIC = bytes([0x76, 0x2F, 0x31, 0x01])
_VERSION_SIZE = 4
_NAMES = 1024
"""So many bytes hold the name and the type of an attribute, of at most 255 each, and its size."""
_AFTER_NAME = 16
"""Bytes of a channel after its name: type, linearity, sampling."""
_START = 65536
"""So many bytes hold the list of channels: attributes are sorted by name, and the long ones come later."""
_HEADER = 1 << 22
"""So many hold all of a header, with Cryptomatte's names of thousands of objects."""

_NEEDED = {"PLGS.Combined.R", "PLGS.Depth.V", "PLGS.Semantic.V", "PLGS.Instance.V"} | {
    "CryptoInstance00.r",
    "CryptoClass00.r",
}


def check_layers(files: Iterable[Path]) -> None:
    """Raises JobError when one of the passes' files is no EXR or lacks a layer that the compositor reads."""
    for path in files:
        missing = _NEEDED - channels_of(path)
        if missing:
            raise JobError(f"is damaged, or has no layer {min(missing)}", path, MAKE_ANEW)


def channels_of(path: Path) -> set[str]:
    """The names of the channels in the file's (first) header; none when it is no EXR. Raises OSError."""
    return set(_names(_attribute(path, b"channels", _START)))


def size_of(path: Path) -> tuple[int, int]:
    """Width and height in pixels of the file's (first) picture; 0, 0 when it is no EXR, or absurd. Raises OSError."""
    window = _attribute(path, b"displayWindow", _HEADER)
    if len(window) != 16:
        return 0, 0
    left, top, right, bottom = struct.unpack("<4i", window)
    width, height = right - left + 1, bottom - top + 1
    return (width, height) if 0 < min(width, height) and max(width, height) <= LARGEST_SIDE else (0, 0)


def _attribute(path: Path, wanted: bytes, most: int) -> bytes:
    """The value of an attribute of the (first) header, where it lies within the first ``most`` bytes; else empty."""
    with open_plain(path) as file:
        start = file.read(most)
    if not start.startswith(_MAGIC):
        return b""
    place = len(_MAGIC) + _VERSION_SIZE
    # name, 0, type, 0, size in 4 bytes, value; an empty name ends the header.
    while start[place : place + 1] not in (b"", b"\0"):
        name, kind, rest = (start[place : place + _NAMES].split(b"\0", 2) + [b"", b""])[:3]
        place += len(name) + len(kind) + 2 + 4
        size = int.from_bytes(rest[:4], "little")
        if name == wanted:
            return start[place : place + size]
        place += size
    return b""


def _names(channels: bytes) -> Iterable[str]:
    while channels[:1] not in (b"", b"\0"):
        name, _, rest = channels.partition(b"\0")
        yield name.decode(errors="replace")
        channels = rest[_AFTER_NAME:]
