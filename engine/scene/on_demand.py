"""Sequences that hold nothing: each item is made when it is asked for, or read back from disk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

Item = TypeVar("Item", covariant=True)


class OnDemand(Sequence[Item]):
    """``count`` items, each made by ``make`` from its number (0..) whenever it is asked for: nothing is kept."""

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
        return self._make(range(self._count)[place])  # the range raises IndexError, and knows numbers from the end


def chained(first: Sequence[Item], second: Sequence[Item]) -> OnDemand[Item]:
    """The items of ``first``, then those of ``second``, each asked for when it is asked for here."""
    start = len(first)
    return OnDemand(start + len(second), lambda place: first[place] if place < start else second[place - start])


class StoredArrays:
    """Arrays on disk, read back by number. For one thread.

    The file lies in ``folder`` (None: the system's for temporary files), has no name where the system allows that, and
    is gone when this object or the process is. Raises OSError when the disk is full.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._file = TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - open as long as this object is
        self._end = 0
        self._stored: list[tuple[int, tuple[int, ...], np.dtype[Any]]] = []

    def __len__(self) -> int:
        return len(self._stored)

    @property
    def nbytes(self) -> int:
        """Of all arrays together."""
        return self._end

    def append(self, array: NDArray[Any]) -> int:
        """Store an array; returns its number."""
        content = np.ascontiguousarray(array).data.cast("B") if array.size else memoryview(b"")
        self._file.seek(self._end)
        written = 0
        while written < len(content):
            written += self._file.write(content[written:])
        self._stored.append((self._end, array.shape, array.dtype))
        self._end += len(content)
        return len(self._stored) - 1

    def __getitem__(self, number: int) -> NDArray[Any]:
        """The array, bit for bit as it was."""
        start, shape, dtype = self._stored[number]
        array = np.empty(shape, dtype)
        room = array.reshape(-1).view(np.uint8).data
        self._file.seek(start)
        read = 0
        while read < len(room):
            got = self._file.readinto(room[read:])
            if not got:
                raise EOFError(f"array {number} is not whole")
            read += got
        return array


def stored(arrays: Iterable[NDArray[Any]], folder: Path | None = None) -> OnDemand[NDArray[Any]]:
    """The arrays, read back from disk whenever they are asked for (see StoredArrays)."""
    on_disk = StoredArrays(folder)
    for array in arrays:
        on_disk.append(array)
    return OnDemand(len(on_disk), on_disk.__getitem__)
