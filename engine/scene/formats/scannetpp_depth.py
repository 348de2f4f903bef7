"""``depth.bin`` of ScanNet++: 256x192 a frame, planar, in one of two ways.

* One raw deflate stream of float32 metres, frame after frame.
* For each frame 4 bytes of size (little endian), then an LZ4 block of 16-bit millimetres or a raw deflate stream of
  float32 metres.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...gates import open_plain
from ..frame import SceneError, Size
from ..pixels import resize_nearest
from .lz4_block import lz4_unpack

_WIDTH, _HEIGHT = 256, 192
_PIXELS = _WIDTH * _HEIGHT
_FIX = "Download it again."
_CHUNK = 1 << 16


class DepthFile:
    """A depth.bin. Where it is one stream it is unpacked forward; a frame that lies behind starts it anew."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._blocks = _find_blocks(path)
        self._lock = Lock()
        self._file: BinaryIO | None = None
        self._unpacker: Any = None
        self._next = 0

    def frame(self, number: int) -> NDArray[np.float32]:
        """Depth of the frame ``number``, float32 [192, 256] metres. Raises SceneError."""
        try:
            if self._blocks is None:
                with self._lock:
                    return self._from_stream(number)
            if number >= len(self._blocks):
                raise SceneError(f"there is no depth of frame {number}", self.path, _FIX)
            with open_plain(self.path) as file:
                file.seek(self._blocks[number][0])
                return _unpack_block(file.read(self._blocks[number][1]))
        except (zlib.error, ValueError, OSError) as error:
            raise SceneError(f"depth of frame {number} cannot be unpacked", self.path, _FIX) from error

    def _from_stream(self, number: int) -> NDArray[np.float32]:
        if self._file is None or number < self._next:
            if self._file is not None:
                self._file.close()
            self._file = open_plain(self.path)
            self._unpacker, self._next = zlib.decompressobj(-zlib.MAX_WBITS), 0
        while True:
            depth = self._unpack(4 * _PIXELS)
            self._next += 1
            if self._next > number:
                return np.frombuffer(depth, "<f4").reshape(_HEIGHT, _WIDTH)

    def _unpack(self, size: int) -> bytes:
        """The next ``size`` bytes of the stream. Raises ValueError at its end."""
        assert self._file is not None
        parts, left = [], size
        while left:
            packed = self._unpacker.unconsumed_tail or self._file.read(_CHUNK)
            part = self._unpacker.decompress(packed, left)
            if not part and not packed:
                raise ValueError("the stream ends")
            parts.append(part)
            left -= len(part)
        return b"".join(parts)


@dataclass(frozen=True, eq=False)
class DepthFileReader:
    """Reads one frame's depth."""

    file: DepthFile
    number: int

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none, at ``size`` (width, height) or its own. Raises SceneError."""
        depth = self.file.frame(self.number)
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))
        return resize_nearest(depth, size) if size else depth


def _find_blocks(path: Path) -> list[tuple[int, int]] | None:
    """Where each frame's block starts and how long it is; None where the sizes do not lead to the file's end."""
    end, blocks, start = path.stat().st_size, [], 0
    with open_plain(path) as file:
        while start < end:
            file.seek(start)
            length = int.from_bytes(file.read(4), "little")
            if not 0 < length <= 8 * _PIXELS or start + 4 + length > end:
                return None
            blocks.append((start + 4, length))
            start += 4 + length
    return blocks


def _unpack_block(data: bytes) -> NDArray[np.float32]:
    """Raises ValueError, zlib.error."""
    try:
        steps = lz4_unpack(data, 2 * _PIXELS)
    except ValueError:
        steps = b""
    if len(steps) == 2 * _PIXELS:
        return np.frombuffer(steps, "<u2").reshape(_HEIGHT, _WIDTH) * np.float32(0.001)
    metres = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, 4 * _PIXELS)
    return np.frombuffer(metres, "<f4").reshape(_HEIGHT, _WIDTH)
