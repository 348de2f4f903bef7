"""Pictures out of a video, decoded when they are asked for."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...gates import open_plain
from ..frame import SceneError, Size
from ..pixels import resize_colour

_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""One of these an MP4 or MOV begins with."""
_MATROSKA = b"\x1a\x45\xdf\xa3"
_FIX = "Copy or record it again, or take its pictures out with another tool."


class Video:
    """One decoder for all frames of a video. It goes forward; a frame that lies behind starts it anew.

    Orientation tags are ignored, as intrinsics refer to the stored pixels.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: Any = None
        self._next = 0
        self._lock = Lock()

    def frame(self, number: int) -> NDArray[np.uint8]:
        """The picture ``number``, counted from 0, uint8 [H, W, 3] RGB. Raises SceneError."""
        with self._lock:
            self._go_to(number)
            good, pixels = self._capture.read()
            self._next = number + 1
        if not good or pixels is None:
            raise SceneError(f"the video has no frame {number}, or it cannot be decoded", self.path, _FIX)
        return np.ascontiguousarray(pixels[..., ::-1])

    def size(self) -> Size:
        """(width, height) of its pictures; decodes one where the header does not tell. Raises SceneError."""
        size = mp4_size(self.path)
        if size is None:
            height, width, _ = self.frame(0).shape
            size = width, height
        return size

    def _go_to(self, number: int) -> None:
        import cv2

        if self._capture is None or number < self._next:
            _refuse_other_files(self.path)
            self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            self._next = 0
            if not self._capture.isOpened():
                self._capture = None
                raise SceneError("the video cannot be opened", self.path, _FIX)
        while self._next < number and self._capture.grab():
            self._next += 1


def _refuse_other_files(path: Path) -> None:
    """Raise SceneError for what is no MP4, MOV, Matroska or AVI by its first bytes: the decoder would follow the
    addresses in a playlist, wherever they lead.
    """
    try:
        with open_plain(path) as file:
            start = file.read(12)
    except OSError as error:
        raise SceneError(f"the video cannot be read ({error.strerror})", path, _FIX) from error
    is_avi = start[:4] == b"RIFF" and start[8:] == b"AVI "
    if start[4:8] not in _BOXES and not start.startswith(_MATROSKA) and not is_avi:
        raise SceneError("this is no MP4, MOV, Matroska or AVI video", path, _FIX)


@dataclass(frozen=True, eq=False)
class VideoColour:
    """Reads one frame of a video."""

    video: Video
    number: int

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB at ``size`` (width, height) or its own. Raises SceneError."""
        pixels = self.video.frame(self.number)
        return resize_colour(pixels, size) if size else pixels


def mp4_size(path: Path) -> Size | None:
    """The size of an MP4's pictures from its headers; None for other videos, and where headers are not as usual."""
    with open_plain(path) as file:
        end = file.seek(0, 2)
        if not any(kind == b"ftyp" for kind, _, _ in _boxes(file, 0, min(end, 64))):
            return None
        for kind, start, stop in _boxes(file, 0, end):
            if kind == b"moov":
                for kind_inside, track, track_end in _boxes(file, start, stop):
                    size = _track_size(file, track, track_end) if kind_inside == b"trak" else None
                    if size is not None:
                        return size
    return None


def _track_size(file: BinaryIO, start: int, stop: int) -> Size | None:
    """A track's width and height, 16.16 fixed point at the end of its header; None for sound."""
    for kind, begin, end in _boxes(file, start, stop):
        if kind == b"tkhd" and end - begin >= 84:
            file.seek(end - 8)
            sides = file.read(8)
            width, height = (side >> 16 for side in struct.unpack(">II", sides)) if len(sides) == 8 else (0, 0)
            return (width, height) if width and height else None
    return None


def _boxes(file: BinaryIO, start: int, stop: int) -> list[tuple[bytes, int, int]]:
    """The boxes between two places of an MP4: kind, and where the content starts and ends."""
    boxes = []
    while start + 8 <= stop:
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            break
        length, kind, begin = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if length == 1 and len(head) == 16:
            length, begin = int.from_bytes(head[8:], "big"), start + 16
        elif length == 0:
            length = stop - start
        if length < begin - start:
            break
        boxes.append((kind, begin, start + length))
        start += length
    return boxes
