"""Pictures from a video, decoded on demand."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import open_plain
from ..frame import Size

_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""An MP4 or MOV begins with one of these."""
_MATROSKA = b"\x1a\x45\xdf\xa3"
_FIX = "Copy or record it again, or extract its pictures with another tool."


class Video:
    """One decoder for all frames of a video. It goes forward; an earlier frame restarts it.

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
        """A function that reads the picture ``number``."""
        return partial(self.frame, number)

    def size(self) -> Size:
        """(width, height) of its pictures, as its header says. Raises PlgsError."""
        import cv2

        with self._lock:
            self._go_to(0)
            width, height = (
                int(self._capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
            )
        if width < 1 or height < 1:
            raise PlgsError("the video does not say how large its pictures are", self.path, _FIX)
        return width, height

    def count(self) -> int:
        """How many pictures it has, as its header says. Raises PlgsError when it cannot be opened, or says none."""
        import cv2

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
        raise PlgsError("this is not an MP4, MOV, Matroska or AVI video", path, _FIX)
