"""Pictures out of a video, decoded on demand."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import open_plain
from ...posed.counts import check_most
from ..frame import Size

_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""An MP4 or MOV begins with one of these."""
_MATROSKA = b"\x1a\x45\xdf\xa3"
_MOST_BOXES = 1 << 17
"""Boxes of one level. Films that are written in parts have two for each part, of some seconds."""
_FIX = "Copy or record it again, or take its pictures out with another tool."


class Video:
    """One decoder for all frames of a video. It goes forward; an earlier frame starts it anew.

    Orientation tags are ignored, as intrinsics refer to the stored pixels.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: Any = None
        self._next = 0
        self._lock = Lock()

    def frame(self, number: int) -> NDArray[np.uint8]:
        """The picture ``number``, counted from 0, uint8 [H, W, 3] RGB. Raises PlgsError."""
        with self._lock:
            self._go_to(number)
            good, pixels = self._capture.read()
            self._next = number + 1
        if not good or pixels is None:
            raise PlgsError(f"the video has no frame {number}, or it cannot be decoded", self.path, _FIX)
        return np.ascontiguousarray(pixels[..., ::-1])

    def reader(self, number: int) -> Callable[[], NDArray[np.uint8]]:
        """What reads the picture ``number``."""
        return partial(self.frame, number)

    def size(self) -> Size:
        """(width, height) of its pictures. One is decoded if the header does not tell. Raises PlgsError."""
        size = mp4_size(self.path)
        if size is None:
            height, width, _ = self.frame(0).shape
            size = width, height
        return size

    def count(self) -> int:
        """How many pictures it has, as its header says. Raises PlgsError when it cannot be opened, or says none."""
        import cv2

        self.size()
        with self._lock:
            self._go_to(0)
            count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if count <= 0:
            raise PlgsError("the video does not say how many pictures it has", self.path, _FIX)
        return count

    def _go_to(self, number: int) -> None:
        import cv2

        if self._capture is None or number < self._next:
            _refuse_other_files(self.path)
            self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            self._next = 0
            if not self._capture.isOpened():
                self._capture = None
                raise PlgsError("the video cannot be opened", self.path, _FIX)
        while self._next < number and self._capture.grab():
            self._next += 1


def _refuse_other_files(path: Path) -> None:
    """Raise PlgsError unless the first bytes are those of an MP4, MOV, Matroska or AVI.

    The decoder would follow the addresses in a playlist, wherever they lead.
    """
    try:
        with open_plain(path) as file:
            start = file.read(12)
    except OSError as error:
        raise PlgsError(f"the video cannot be read ({error.strerror})", path, _FIX) from error
    is_avi = start[:4] == b"RIFF" and start[8:] == b"AVI "
    if start[4:8] not in _BOXES and not start.startswith(_MATROSKA) and not is_avi:
        raise PlgsError("this is no MP4, MOV, Matroska or AVI video", path, _FIX)


def mp4_size(path: Path) -> Size | None:
    """The size of an MP4's pictures from its headers; None for other videos and for unusual headers."""
    with open_plain(path) as file:
        end = file.seek(0, 2)
        if not any(_boxes(file, b"ftyp", 0, min(end, 64))):
            return None
        tracks = (each for movie in _boxes(file, b"moov", 0, end) for each in _boxes(file, b"trak", *movie))
        for begin, stop in (head for track in tracks for head in _boxes(file, b"tkhd", *track)):
            if stop - begin >= 84:
                file.seek(stop - 8)  # 16.16 fixed point at the end of a track's header; 0 for sound
                sides = file.read(8)
                width, height = (side >> 16 for side in struct.unpack(">II", sides)) if len(sides) == 8 else (0, 0)
                if width and height:
                    return width, height
    return None


def _boxes(file: BinaryIO, wanted: bytes, start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Where the content of each box of the kind ``wanted`` starts and ends, between two places of an MP4."""
    number = 0
    while start + 8 <= stop:
        number += 1
        check_most(number, "parts", file.name, _FIX, _MOST_BOXES)
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            return
        length, kind, begin = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if length == 1 and len(head) == 16:
            length, begin = int.from_bytes(head[8:], "big"), start + 16
        elif length == 0:
            length = stop - start
        if length < begin - start:
            return
        if kind == wanted:
            yield begin, start + length
        start += length
