"""Sequences that hold nothing: each item is made on demand, or read back from disk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import prod
from os import SEEK_END
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from ..posed.camera import Camera
from .frame import PanopticMask, Segment
from .view import View

Item = TypeVar("Item", covariant=True)


class OnDemand(Sequence[Item]):
    """``count`` items, each made by ``make`` from its number (0..) at every access."""

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
    """The items of ``first``, then those of ``second``, each fetched on demand."""
    start = len(first)
    return OnDemand(start + len(second), lambda place: first[place] if place < start else second[place - start])


Progress = Callable[[int, int], object]
"""Called with (done, total); may raise to stop."""


def part_of(whole: Progress, begin: float, end: float) -> Progress:
    """The progress of a part, which lasts from one share of the whole to another. The whole is told whole per cents."""
    return lambda done, total: whole(round(100 * (begin + (end - begin) * done / max(total, 1))), 100)


def watched(items: Sequence[Item], progress: Progress) -> OnDemand[Item]:
    """The items; ``progress`` is called with (number, count) before each is fetched."""
    return OnDemand(len(items), lambda place: (progress(place, len(items)), items[place])[1])


class StoredArrays:
    """Arrays on disk, read back by number. For one thread.

    The file lies in ``folder`` (None: the system's for temporary files), has no name if the system allows that, and is
    deleted with this object or at the end of the process. Raises OSError when the disk is full.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._file = TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - open until this object is gone
        self._places: list[tuple[int, np.dtype[Any], tuple[int, ...]]] = []

    def __len__(self) -> int:
        return len(self._places)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays together."""
        return self._file.seek(0, SEEK_END)

    def append(self, array: NDArray[Any]) -> int:
        """Store an array; returns its number."""
        whole = np.ascontiguousarray(array)
        self._places.append((self.nbytes, whole.dtype, whole.shape))
        whole.tofile(self._file)  # without a header, whose reading takes longer than that of a small array
        return len(self) - 1

    def __getitem__(self, number: int) -> NDArray[Any]:
        """The array, bit for bit as it was."""
        start, dtype, shape = self._places[number]
        self._file.seek(start)
        return np.fromfile(self._file, dtype, prod(shape)).reshape(shape)


def stored(arrays: Iterable[NDArray[Any]], folder: Path | None = None) -> OnDemand[NDArray[Any]]:
    """The arrays, read back from disk on demand (see StoredArrays)."""
    on_disk = StoredArrays(folder)
    for array in arrays:
        on_disk.append(array)
    return OnDemand(len(on_disk), on_disk.__getitem__)


class StoredViews(OnDemand[View]):
    """Views on disk, in their order, each read back on demand, bit for bit: a long scan does not fit into memory.

    They are stored one after another in ``folder`` (see StoredArrays). ``stored`` is called with their number so far.
    """

    def __init__(
        self, views: Iterable[View], folder: Path | None = None, stored: Callable[[int], object] | None = None
    ) -> None:
        self._arrays = StoredArrays(folder)
        self._about: list[tuple[str, Camera, tuple[Segment, ...], int | None, float]] = []
        for view in views:
            for array in (view.colour, view.depth, view.mask.ids):
                self._arrays.append(array)
            border = None if view.border is None else self._arrays.append(view.border)
            self._about.append((view.name, view.camera, view.mask.segments, border, view.mask_scale))
            if stored is not None:
                stored(len(self._about))
        self._first = np.cumsum([0, *(3 + (border is not None) for *_, border, _ in self._about)]).tolist()
        super().__init__(len(self._about), self._read)

    @property
    def cameras(self) -> list[Camera]:
        return [camera for _, camera, *_ in self._about]

    def _read(self, number: int) -> View:
        name, camera, segments, border, scale = self._about[number]
        colour, depth, ids = (self._arrays[self._first[number] + place] for place in range(3))
        edge = None if border is None else self._arrays[border]
        return View(name, camera, colour, depth, PanopticMask(ids, segments), edge, scale)
