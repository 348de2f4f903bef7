"""Arrays out of HDF5 files, through h5py."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..frame import SceneError

_FIX = "Download this file again."
_LARGEST = 2**27
"""Numbers in one array: a picture of 8192x5461 in colour."""


def read_hdf5(path: Path, dimensions: int) -> NDArray[Any]:
    """The array called "dataset", of numbers. Raises SceneError."""
    with _dataset(path, dimensions) as dataset:
        values: NDArray[Any] = dataset[()]
    return values


def shape_of_hdf5(path: Path, dimensions: int) -> tuple[int, ...]:
    """The shape of the array called "dataset"; it is not read. Raises SceneError."""
    with _dataset(path, dimensions) as dataset:
        return tuple(int(side) for side in dataset.shape)


@contextmanager
def _dataset(path: Path, dimensions: int) -> Iterator[Any]:
    try:
        import h5py
    except ImportError as error:
        fix = "Let the engine's Python install it: python -m pip install -r requirements/readers.txt."
        raise SceneError("HDF5 files need the package h5py", path, fix) from error
    if not path.is_file():
        raise SceneError("the file is missing", path, _FIX)
    try:
        with h5py.File(path, "r") as file:  # is_file above: no FIFO
            dataset = file.get("dataset")
            if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
                raise SceneError('there is no array of numbers called "dataset"', path, _FIX)
            if dataset.ndim != dimensions or not 0 < np.prod(dataset.shape, dtype=np.float64) <= _LARGEST:
                raise SceneError(f"the array has the shape {dataset.shape}", path, _FIX)
            yield dataset
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise SceneError("the file cannot be read, or is cut off", path, _FIX) from error
