"""Which layers an OpenEXR file has, read off its first bytes. Plain Python.

Blender says of a damaged file no more than that its image has no size, and nodes then take no layer of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..engine.gates import open_plain
from ..engine.job import JobError

_MAGIC = bytes([0x76, 0x2F, 0x31, 0x01])
_VERSION_SIZE = 4
_AFTER_NAME = 16
"""Bytes of a channel after its name: type, linearity, sampling."""
_START = 65536
"""So many bytes hold the list of channels: attributes are sorted by name, and the long ones come later."""

_NEEDED = {"PLGS.Combined.R", "PLGS.Depth.V", "PLGS.Semantic.V", "PLGS.Instance.V"} | {
    "CryptoInstance00.r",
    "CryptoClass00.r",
}


def check_layers(files: Iterable[Path]) -> None:
    """Raises JobError when one of the passes' files is no EXR or lacks a layer that the compositor reads."""
    for path in files:
        missing = _NEEDED - channels_of(path)
        if missing:
            fix = "Delete the file and bake its frame again."
            raise JobError(f"is damaged, or has no layer {min(missing)}", path, fix)


def channels_of(path: Path) -> set[str]:
    """The names of the channels in the file's (first) header; none when it is no EXR. Raises OSError."""
    with open_plain(path) as file:
        start = file.read(_START)
    if not start.startswith(_MAGIC):
        return set()
    place = len(_MAGIC) + _VERSION_SIZE
    # name, 0, type, 0, size in 4 bytes, value; an empty name ends the header.
    while start[place : place + 1] not in (b"", b"\0"):
        name, kind, rest = (start[place:].split(b"\0", 2) + [b"", b""])[:3]
        place += len(name) + len(kind) + 2 + 4
        size = int.from_bytes(rest[:4], "little")
        if name == b"channels":
            return set(_names(start[place : place + size]))
        place += size
    return set()


def _names(channels: bytes) -> Iterable[str]:
    while channels[:1] not in (b"", b"\0"):
        name, _, rest = channels.partition(b"\0")
        yield name.decode(errors="replace")
        channels = rest[_AFTER_NAME:]
