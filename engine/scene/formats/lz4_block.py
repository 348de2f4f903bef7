"""LZ4's block format, as its specification describes it: a dozen lines, for one format that some captures use."""

from __future__ import annotations


def lz4_unpack(data: bytes, largest: int) -> bytes:
    """The bytes of one block, at most ``largest``. Raises ValueError when it is damaged."""
    out, i = bytearray(), 0
    while i < len(data):
        token = data[i]
        length, i = _length(data, i + 1, token >> 4)
        if i + length > len(data):
            raise ValueError("the block is cut off")
        out += data[i : i + length]
        i += length
        if i == len(data):
            break
        back = int.from_bytes(data[i : i + 2], "little")
        length, i = _length(data, i + 2, token & 15)
        if not 0 < back <= len(out) or len(out) + length + 4 > largest:
            raise ValueError("the block is damaged")
        # A match may reach into what it writes itself: then it repeats.
        match = bytes(out[-back:])
        out += (match * ((length + 4) // back + 1))[: length + 4]
    if len(out) > largest:
        raise ValueError("the block is too long")
    return bytes(out)


def _length(data: bytes, i: int, start: int) -> tuple[int, int]:
    """A length that goes on in further bytes while these are 255, and where it ends."""
    length = start
    if start == 15:
        while True:
            if i >= len(data):
                raise ValueError("the block is cut off")
            length += data[i]
            i += 1
            if data[i - 1] != 255:
                break
    return length, i
