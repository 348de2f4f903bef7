"""An LZFSE stream unpacks to no more than it may, whatever its blocks say. Its library is a pretended one."""

from __future__ import annotations

import base64
import struct

import pytest

from engine.scene.formats.lzfse_blocks import unpack
from tests.scene.formats.test_record3d import stored, unstored

USUAL = base64.b64decode(
    "YnZ4MsASAAAUAIAAAAQAEGgtdRxoDwAQkQAAADLQgAyPAABwCBwCAIcAAAAAHD4Cj8ajAACPAgAAAAAAAAAAAAAAAAAAAAAAAAAAAPC2AAAAAAAAAAAA"
    "AAAAAAAAAADvxG8AvwHwtcDXAu8EwDsBAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAACI7GisHh4AAAAAAAAAAAAAA/g/8H8AYnZ4JA=="
)
"""What Apple's library makes of "hello world " 400 times, 4800 bytes."""
ONE, END = USUAL[:-4], USUAL[-4:]


class Library:
    """Unpacks every usual block to ``size`` bytes, whatever it says, and notes the most that it was asked for."""

    def __init__(self, size: int) -> None:
        self._size, self.most = size, 0

    def __call__(self, data: bytes) -> bytes:
        self.most = max(self.most, data.count(b"bvx2") * self._size)
        return bytes(data.count(b"bvx2") * self._size)


def test_what_is_as_it_says_comes_out() -> None:
    assert unpack(stored(b"depth"), 5, unstored) == b"depth"
    for blocks in (1, 4, 8, 9, 30):
        assert len(unpack(ONE * blocks + END, 48_000 * 30, Library(4800))) == 4800 * blocks


def test_what_says_more_than_may_be_reaches_no_library() -> None:
    library = Library(4800)
    vast = ONE[:4] + struct.pack("<I", 2**32 - 1) + ONE[8:] + END
    for data in (vast, ONE * 2 + END, b"bvxn" + struct.pack("<II", 2**32 - 1, 4) + b"abcd" + END, ONE * 10_000 + END):
        with pytest.raises(ValueError, match="unpacks to more than|too many blocks"):
            unpack(data, 4800, library)
    assert library.most == 0


def test_what_says_less_than_it_is_does_not_get_far() -> None:
    library = Library(27_000_000)
    with pytest.raises(ValueError, match="another size than it says"):
        unpack(ONE * 30 + END, 4800 * 100, library)
    assert library.most == 8 * 27_000_000


@pytest.mark.parametrize(
    "data", [b"", b"bvx", ONE, USUAL[:100], USUAL[:20], USUAL[4:], b"bvx1" + bytes(800) + END, b"bvx-\xff\0\0\0" + END]
)
def test_what_is_no_whole_stream(data: bytes) -> None:
    with pytest.raises(ValueError):
        unpack(data, 10**6, Library(4800))
