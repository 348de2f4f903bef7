"""LZFSE streams, unpacked up to a size: their library takes what memory they ask for.

A stream is blocks, each with a header. That says how much the block unpacks to, but the library does not go by it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

_STORED, _SHORT, _USUAL, _END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"
_FULL_BLOCK = 10_000
"""Bytes: all blocks but the last unpack to more, as they are full with 10 000 matches or 40 000 literals."""
_AT_ONCE = 8
"""Blocks that are unpacked before what they claim is compared with what came out: a block cannot grow beyond 27 MB."""


class _Block(NamedTuple):
    """Where it ends in the stream, and the bytes that all blocks up to it claim to unpack to."""

    end: int
    unpacked: int


def unpack(data: bytes, most_bytes: int, decompress: Callable[[bytes], bytes]) -> bytes:
    """What a stream holds. Raises ValueError for what is no whole stream, or holds more than ``most_bytes``, and what
    ``decompress`` raises.
    """
    blocks = _blocks(data, 4 + most_bytes // _FULL_BLOCK)
    if blocks and blocks[-1].unpacked > most_bytes:
        raise ValueError(f"it unpacks to more than {most_bytes} bytes")
    for block in blocks[_AT_ONCE - 1 : -1 : _AT_ONCE]:
        _refuse_more(decompress(data[: block.end] + _END), block.unpacked)
    unpacked = decompress(data)
    _refuse_more(unpacked, blocks[-1].unpacked if blocks else 0)
    return unpacked


def _refuse_more(unpacked: bytes, claimed: int) -> None:
    if len(unpacked) != claimed:
        raise ValueError("a block unpacks to another size than it says")


def _blocks(data: bytes, most: int) -> list[_Block]:
    """Raises ValueError when it is cut off, or there are more than ``most``."""
    found, place, unpacked = list[_Block](), 0, 0
    try:
        while (kind := data[place : place + 4]) != _END:
            (claimed,) = struct.unpack_from("<I", data, place + 4)
            place, unpacked = place + _length(data, place, kind, claimed), unpacked + claimed
            found.append(_Block(place, unpacked))
            if len(found) > most:
                raise ValueError("it has too many blocks")
    except struct.error as error:
        raise ValueError("it is cut off") from error
    return found


def _length(data: bytes, place: int, kind: bytes, claimed: int) -> int:
    """Bytes of a block with its header. Raises ValueError, struct.error."""
    if kind == _STORED:
        return 8 + claimed
    if kind == _SHORT:
        return 12 + int(struct.unpack_from("<I", data, place + 8)[0])
    if kind != _USUAL:
        raise ValueError("it has a block of a kind that is not known")
    # Numbers of 20 bits lie in 64: literals' bytes from bit 20 of the first, matches' from bit 40 of the second.
    first, second, third = struct.unpack_from("<3Q", data, place + 8)
    return (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
