"""Views: a frame's pixels at one common size, for the lift, without black borders from undistortion; threads that read
frames ahead; and sequences whose items are made on demand, or read back from disk."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import prod
from os import SEEK_END, fstat
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from ..job.progress import Progress as Progress
from ..posed.frames import Camera
from .frame import Frame, PanopticMask, Segment, Size
from .pixels import resize_colour, resize_nearest

BLACK, JPEG_BLACK = 2, 12  # most brightness of a border: its median, and each pixel, as JPEG brightens some
THICKEST = 0.1  # maximum border width, as a fraction of the image; wider dark areas are things in the picture
SHORTEST = 0.125  # minimum border length, as a fraction of the side
STEEPEST = 2
"""Maximum change of a border's width, in pixels, from one pixel along the side to the next: undistortion is smooth, the
outlines of furniture are not."""
SEAM = 2  # pixels beside a border that resampling and JPEG have blended with it


def border_mask(colour: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels of a full-size picture, uint8 [H, W, 3], that belong to a black border, bool [H, W]. A border
    is thin, black, smooth and along a side; dark things reach farther in, are ragged or are not quite black."""
    import cv2

    sides = (colour[0], colour[-1], colour[:, 0], colour[:, -1])
    if all((side.max(axis=1) <= JPEG_BLACK).mean() < SHORTEST for side in sides):  # most pictures end here
        return np.zeros(colour.shape[:2], np.bool_)
    brightest = colour.max(axis=2)
    dark = cv2.medianBlur(brightest, 3) <= JPEG_BLACK  # the median: single pixels that JPEG made brighter
    border = np.zeros(dark.shape, np.bool_)
    for turns in range(4):  # each side in its turn is the upper one; a turned view writes into ``border`` itself
        _add_upper(np.rot90(border, turns), np.rot90(dark, turns), np.rot90(brightest, turns))
    if border.any():
        kernel = np.ones((2 * SEAM + 1, 2 * SEAM + 1), np.uint8)
        border = cv2.dilate(border.view(np.uint8), kernel).astype(np.bool_)  # OpenCV takes no bool
    return border


def _add_upper(border: NDArray[np.bool_], dark: NDArray[np.bool_], brightest: NDArray[np.uint8]) -> None:
    """Mark the border along the upper side in ``border``; all arrays are [H, W]."""
    height, width = dark.shape
    thickness = np.where(dark.all(axis=0), height, dark.argmin(axis=0))  # argmin is 0 where all are dark
    is_thin = (thickness > 0) & (thickness <= THICKEST * height)
    is_torn = ~is_thin[1:] | ~is_thin[:-1] | (np.abs(np.diff(thickness)) > STEEPEST)
    for stretch in np.split(np.arange(width), np.flatnonzero(is_torn) + 1):
        inside = np.arange(height)[:, None] < np.where(is_thin, thickness, 0)[stretch]
        if len(stretch) >= SHORTEST * width and inside.any() and np.median(brightest[:, stretch][inside]) <= BLACK:
            border[:, stretch] |= inside


Given = TypeVar("Given")
Made = TypeVar("Made")
MAKERS = 2  # threads that work ahead; more would fill the memory with waiting pictures
NEAR, NEAR_SHARE = 0.05, 0.02
"""A view sees a point if its depth there differs by at most this many metres, or this fraction."""

Rows = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class View:
    """A frame's pixels at the size of ``camera``: colour uint8 [H, W, 3], depth float32 [H, W] metres (0 = none) and
    mask. ``border`` bool [H, W] marks pixels of a black border and those that do not count; None if there are none.
    ``mask_scale`` is the side of a pixel in pixels of the frame's own mask. ``layers`` are the detections over the
    mask, sorted into masks without overlaps. If `layer` made the view, ``frame`` is the frame's name, else ""."""

    name: str
    camera: Camera
    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: PanopticMask
    border: NDArray[np.bool_] | None = None
    mask_scale: float = 1.0
    layers: Sequence[PanopticMask] = ()
    frame: str = ""

    def layer(self, number: int) -> View:
        """Return one of the layers as a view of the same frame."""
        name = f"{self.name}#{number}"
        return replace(self, name=name, mask=self.layers[number], layers=(), frame=self.name)

    def places_in(self, xyz: NDArray[np.floating]) -> tuple[Rows, Rows, Rows, NDArray[np.float64]]:
        """Return which of the world points ``xyz`` [N, 3] project into the picture, hidden ones included: their rows
        [n], the row and column [n] of each one's pixel, and its planar depth in metres, float64 [n]."""
        number, pixel, depth = self.camera.seen(xyz)
        x, y = pixel.astype(np.int64).T
        return number, y, x, depth

    def seen_of(self, xyz: NDArray[np.floating], near: float = NEAR) -> tuple[Rows, Rows, Rows]:
        """Return which of the points ``xyz`` [N, 3] the view sees: those within ``near`` metres, or NEAR_SHARE, of its
        own depth. Returns their rows [n], and the row and column [n] of each one's pixel."""
        number, y, x, depth = self.places_in(xyz)
        measured = self.depth[y, x]
        shows = (measured > 0) & (np.abs(measured - depth) <= np.maximum(near, NEAR_SHARE * measured))
        return number[shows], y[shows], x[shows]


def load_view(frame: Frame, size: Size | None = None) -> View:
    """Read a frame at ``size`` (None: its own). Raises PlgsError if a file is bad, or depth or mask is missing."""
    width, height = size or frame.size
    colour = frame.read_colour(None)
    border = border_mask(colour)
    if frame.read_kept is not None:
        border |= ~frame.read_kept((colour.shape[1], colour.shape[0]))
    return View(
        name=frame.name,
        camera=frame.camera.resized(width, height),
        colour=resize_colour(colour, (width, height)),
        depth=frame.depth((width, height)),
        mask=frame.mask((width, height)),
        border=resize_nearest(border, (width, height)) if border.any() else None,
        mask_scale=frame.size[0] / width,
        layers=frame.layers((width, height)),
    )


def made_ahead(items: Sequence[Given], make: Callable[[Given], Made]) -> Iterator[Made]:
    """Yield ``make(item)`` of each item in order, some made ahead in threads, as decoding, kernels and large arrays
    release Python's lock. Errors are raised at their item's turn."""
    pool, waiting = ThreadPoolExecutor(MAKERS, "ahead"), deque[Future[Made]]()
    try:
        for number in range(len(items) + MAKERS):
            if number < len(items):
                waiting.append(pool.submit(lambda number: make(items[number]), number))
            if number >= MAKERS:
                yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)  # whoever iterates may stop early


def read_ahead(frames: Sequence[Frame], read: Callable[[Frame], Made]) -> Iterator[Made]:
    """Yield ``read(frame)`` of each frame in order, ahead as `made_ahead`, or one by one if one file has them all."""
    one_by_one = not all(frame.file_shows_colour for frame in frames)
    yield from map(read, frames) if one_by_one else made_ahead(frames, read)


Item = TypeVar("Item", covariant=True)


class OnDemand(Sequence[Item]):
    """A sequence of ``count`` items, each made by ``make`` from its index (0..) at every access."""

    def __init__(self, count: int, make: Callable[[int], Item]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, place: int) -> Item: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[Item]: ...

    def __getitem__(self, place: int | slice) -> Item | Sequence[Item]:
        if isinstance(place, slice):
            chosen = range(self._count)[place]
            return OnDemand(len(chosen), lambda number: self._make(chosen[number]))
        return self._make(range(self._count)[place])  # the range raises IndexError, and takes negative numbers


def chained(first: Sequence[Item], second: Sequence[Item]) -> OnDemand[Item]:
    """Return the items of ``first``, then those of ``second``, each fetched on demand."""
    start = len(first)
    return OnDemand(start + len(second), lambda index: first[index] if index < start else second[index - start])


def watched(items: Sequence[Item], progress: Progress) -> OnDemand[Item]:
    """Return the items as a sequence that calls ``progress`` with (number, count) before it fetches one."""
    return OnDemand(len(items), lambda index: (progress(index, len(items)), items[index])[1])


class StoredArrays:
    """Arrays on disk, read back by number, in any thread. The file is in ``folder`` (None: the system's for
    temporary files) and is deleted with this object or at the process's end. Raises OSError if the disk is full."""

    def __init__(self, folder: Path | None = None) -> None:
        self._file = TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - open until this object is gone
        self._places: list[tuple[int, np.dtype[Any], tuple[int, ...]]] = []
        self._lock = Lock()  # the file has one position

    def __len__(self) -> int:
        return len(self._places)

    @property
    def nbytes(self) -> int:
        return fstat(self._file.fileno()).st_size

    def append(self, array: NDArray[Any]) -> int:
        """Store an array and return its number."""
        whole = np.ascontiguousarray(array)
        rest = whole.reshape(-1).view(np.uint8).data  # numpy's tofile raises an OSError without its number
        with self._lock:
            self._places.append((self._file.seek(0, SEEK_END), whole.dtype, whole.shape))
            while len(rest):
                rest = rest[self._file.write(rest) :]
            return len(self) - 1

    def __getitem__(self, number: int) -> NDArray[Any]:
        """Return the array, bit for bit as it was."""
        start, dtype, shape = self._places[number]
        with self._lock:
            self._file.seek(start)
            return np.fromfile(self._file, dtype, prod(shape)).reshape(shape)


def stored(arrays: Iterable[NDArray[Any]], folder: Path | None = None) -> OnDemand[NDArray[Any]]:
    """Store the arrays on disk. Returns a sequence that reads each one back when it is needed (see StoredArrays)."""
    on_disk = StoredArrays(folder)
    for array in arrays:
        on_disk.append(array)
    return OnDemand(len(on_disk), on_disk.__getitem__)


class StoredViews(OnDemand[View]):
    """Views on disk, in order, each read back on demand, bit for bit, as a long scan does not fit into memory. They are
    stored one after another in ``folder`` (see StoredArrays). ``stored`` is called with the number stored so far."""

    def __init__(
        self, views: Iterable[View], folder: Path | None = None, stored: Callable[[int], object] | None = None
    ) -> None:
        self._arrays = StoredArrays(folder)
        self._about: list[tuple[str, Camera, float, list[int], int | None, list[tuple[Segment, ...]]]] = []
        for view in views:
            masks = [view.mask, *view.layers]
            arrays: list[NDArray[Any]] = [view.colour, view.depth, *(mask.ids for mask in masks)]
            border = None if view.border is None else self._arrays.append(view.border)
            numbers, segments = [self._arrays.append(array) for array in arrays], [mask.segments for mask in masks]
            self._about.append((view.name, view.camera, view.mask_scale, numbers, border, segments))
            if stored is not None:
                stored(len(self._about))
        super().__init__(len(self._about), self._read)

    def _read(self, number: int) -> View:
        name, camera, scale, (colour, depth, *ids), border, segments = self._about[number]
        edge = None if border is None else self._arrays[border]
        masks = OnDemand(len(ids), lambda index: PanopticMask(self._arrays[ids[index]], segments[index]))
        return View(name, camera, self._arrays[colour], self._arrays[depth], masks[0], edge, scale, masks[1:])
