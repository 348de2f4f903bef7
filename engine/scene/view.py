"""Views: a frame's pixels, all brought to one size, for the lift; and frames read ahead by threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..posed.camera import Camera
from .borders import border_mask
from .frame import Frame, PanopticMask, Size
from .pixels import resize_colour, resize_nearest

Read = TypeVar("Read")
READERS = 2
"""Threads that read ahead. With more, waiting pictures would fill the memory."""
NEAR, NEAR_SHARE = 0.05, 0.02
"""A view sees a place if its depth there differs by at most so many metres, usually, or this share of it."""

Rows = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class View:
    """Colour uint8 [H, W, 3], depth float32 [H, W] metres (0 = none) and mask of a frame at the size of ``camera``.

    ``border`` bool [H, W] marks the pixels of a black border. It is None in pictures without one. ``mask_scale`` is how
    many pixels of the frame's own mask the side of a pixel spans.
    """

    name: str
    camera: Camera
    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: PanopticMask
    border: NDArray[np.bool_] | None = None
    mask_scale: float = 1.0

    def places_in(self, xyz: NDArray[np.floating]) -> tuple[Rows, Rows, Rows, NDArray[np.float64]]:
        """The rows [n] of the world's places ``xyz`` [N, 3] that lie within the picture, whatever stands before them;
        the row and the column of each one's pixel, and its planar depth, float64 [n]."""
        number, pixel, depth = self.camera.seen(xyz)
        x, y = pixel.astype(np.int64).T
        return number, y, x, depth

    def seen_of(self, xyz: NDArray[np.floating], near: float = NEAR) -> tuple[Rows, Rows, Rows]:
        """The rows [n] of those places ``xyz`` [N, 3] that the view's own depth shows, within ``near`` metres or
        NEAR_SHARE of it, and the row and the column of each one's pixel."""
        number, y, x, depth = self.places_in(xyz)
        measured = self.depth[y, x]
        shows = (measured > 0) & (np.abs(measured - depth) <= np.maximum(near, NEAR_SHARE * measured))
        return number[shows], y[shows], x[shows]


def load_view(frame: Frame, size: Size | None = None) -> View:
    """Read a frame at ``size`` (width, height), or at its own size. Raises PlgsError when a file is bad, or when
    the frame has no depth or no mask.
    """
    width, height = size or frame.size
    colour = frame.read_colour(None)
    border = border_mask(colour)
    return View(
        name=frame.name,
        camera=frame.camera.resized(width, height),
        colour=resize_colour(colour, (width, height)),
        depth=frame.depth((width, height)),
        mask=frame.mask((width, height)),
        border=resize_nearest(border, (width, height)) if border.any() else None,
        mask_scale=frame.size[0] / width,
    )


def read_ahead(frames: Sequence[Frame], read: Callable[[Frame], Read]) -> Iterator[Read]:
    """``read`` of each frame in its order, a few frames ahead. Decoding a picture does not hold Python's lock.

    Frames of one file, such as a video, are read one after another. Errors of ``read`` come at the frame's own place.
    """
    if not all(frame.file_shows_colour for frame in frames):
        yield from map(read, frames)
        return
    with ThreadPoolExecutor(READERS, "read") as pool:
        waiting: deque[Future[Read]] = deque()
        try:
            for frame in frames:
                waiting.append(pool.submit(read, frame))
                if len(waiting) > 2 * READERS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
