"""Masks as arrays, of .npy and .npz files. Headers come first: what is too large or pickled is not read."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ...gates import open_plain
from ..array_file import read_npy, read_npz
from ..frame import SceneError

LARGEST_BYTES = 2**30
_FIX = "Write it again with numpy.save."
_DAMAGED = (
    ValueError, TypeError, EOFError, KeyError, SyntaxError, tokenize.TokenError, NotImplementedError, RuntimeError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What numpy and zipfile raise for a file that is damaged or something else."""


@dataclass(frozen=True)
class ArrayHeader:
    """What an array is, without its numbers."""

    shape: tuple[int, ...]
    kind: str  # numpy's letter: b, i, u, f, U


def array_headers(path: Path) -> dict[str, ArrayHeader]:
    """The arrays of an .npz by name; the one of an .npy is called "". Raises SceneError."""
    try:
        if path.suffix.lower() == ".npy":
            with open_plain(path) as file:
                return {"": _header(file, path)}
        found = {}
        with open_plain(path) as packed, zipfile.ZipFile(packed) as archive:
            for info in archive.infolist():
                if info.filename.endswith(".npy"):
                    with archive.open(info) as member:
                        found[info.filename.removesuffix(".npy")] = _header(member, path)
        return found
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    except _DAMAGED as error:
        raise _no_arrays(path) from error


def read_array(path: Path, name: str = "") -> NDArray[Any]:
    """The array ``name`` of an .npz, or that of an .npy. Raises SceneError."""
    headers = array_headers(path)
    if name not in headers:
        raise SceneError(f'there is no array called "{name}"', path, f"It has {', '.join(headers) or 'none'}.")
    try:
        if not name and path.suffix.lower() == ".npy":
            return read_npy(path, _FIX, LARGEST_BYTES)
        return read_npz(path, _FIX, [name], LARGEST_BYTES)[name]
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    except _DAMAGED as error:
        raise _no_arrays(path) from error


def _header(file: IO[bytes], path: Path) -> ArrayHeader:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        fix = "Save numbers with numpy.save, and what belongs to them as JSON."
        raise SceneError("this is a pickled array, which could run code when it is read", path, fix)
    if float(np.prod(shape, dtype=np.float64)) * dtype.itemsize > LARGEST_BYTES:
        sides = " x ".join(map(str, shape))
        raise SceneError(f"an array of {sides} numbers is too large for a picture", path, "Save one frame a file.")
    return ArrayHeader(tuple(shape), dtype.kind)


def _no_arrays(path: Path) -> SceneError:
    return SceneError("this is no NumPy file of numbers, or it is cut off", path, _FIX)
