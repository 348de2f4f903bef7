"""Reads NumPy's .npy and .npz files. Pickles are refused, and so are arrays with more bytes than a given limit."""

from __future__ import annotations

import tokenize
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError, reading
from ..gates import open_plain, read_plain

MOST_BYTES = 1 << 28  # maximum bytes of all unpacked arrays of a file: some five million labelled points
LARGEST_PICTURE = 1 << 30  # maximum bytes of an array with one frame's masks
_NO_ARRAYS = "this is not a NumPy file of numbers, or it is cut off"
_SAVE_FIX = "Write it again with numpy.save."
_DAMAGED = (
    ValueError, TypeError, EOFError, KeyError, SyntaxError, tokenize.TokenError, NotImplementedError, RuntimeError,
    BadZipFile, zlib.error,
)  # fmt: skip
"""Exceptions of numpy and zipfile for a damaged or unrelated file."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(
    path: Path, fix: str, names: Collection[str] | None = None, most_bytes: int = MOST_BYTES
) -> dict[str, NDArray[Any]]:
    """Return arrays of an .npz by name: those in ``names``, or all. Raises PlgsError, with ``fix`` as advice, for a
    damaged file, a missing array, an array of objects, and more than ``most_bytes`` of unpacked numbers."""
    try:
        with open_plain(path) as file, ZipFile(file) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            wanted = {name: entries[name] for name in (entries if names is None else names)}
            size = sum(entry.file_size for entry in wanted.values())
            if size > most_bytes:
                what = f"it would unpack to {size / 1e6:.0f} MB, but at most {most_bytes / 1e6:.0f} MB are allowed"
                raise PlgsError("array-too-large", what, path, fix)
            return {name: _array(BytesIO(archive.read(entry))) for name, entry in wanted.items()}
    except PlgsError:
        raise
    except KeyError as error:
        raise PlgsError("no-array", f"the file has no array {error}", path, fix) from error
    except Exception as error:  # zip, deflate and the parser of headers raise errors of many kinds
        raise PlgsError("array-unreadable", f"the arrays cannot be read ({_reason(error)})", path, fix) from error


def read_npy(path: Path, fix: str, most_bytes: int = MOST_BYTES) -> NDArray[Any]:
    """Read the array of a .npy of at most ``most_bytes``. Raises PlgsError, with ``fix`` as advice, for other files."""
    with reading(path, fix):
        content = read_plain(path, most_bytes)
    try:
        return _array(BytesIO(content))
    except Exception as error:
        raise PlgsError("not-array", f"this is not a NumPy array of numbers ({_reason(error)})", path, fix) from error


def _array(file: IO[bytes]) -> NDArray[Any]:
    """Read the array of a .npy. Memory is taken only for data that the file really has. Raises many kinds of errors."""
    values: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    if not values.dtype.itemsize:  # dtype V0 or U0: any number of rows would need no bytes
        raise ValueError("its numbers have no size")
    return values


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:100] or type(error).__name__


@dataclass(frozen=True)
class ArrayHeader:
    """The shape and type of a stored array, without its data. ``kind`` is numpy's letter: b, i, u, f, U."""

    shape: tuple[int, ...]
    kind: str


def array_headers(path: Path) -> dict[str, ArrayHeader]:
    """Return the headers of an .npz's arrays by name; "" is that of a .npy. Raises PlgsError for damage and pickles."""
    try:
        with reading(path), open_plain(path) as file:
            if path.suffix.lower() == ".npy":
                return {"": _header(file, path)}
            found = {}
            with ZipFile(file) as archive:
                for info in archive.infolist():
                    if info.filename.endswith(".npy"):
                        with archive.open(info) as member:
                            found[info.filename.removesuffix(".npy")] = _header(member, path)
            return found
    except _DAMAGED as error:
        raise PlgsError("not-array", _NO_ARRAYS, path, _SAVE_FIX) from error


def read_array(path: Path, name: str = "") -> NDArray[Any]:
    """Read a frame's masks: the array ``name`` of an .npz, or the only one of an .npy. Raises PlgsError if it is
    damaged or there is no such array."""
    headers = array_headers(path)
    if name not in headers:
        what = f'there is no array called "{name}"'
        raise PlgsError("no-array", what, path, f"Give one of its arrays that name: {', '.join(headers) or 'none'}.")
    if not name and path.suffix.lower() == ".npy":
        return read_npy(path, _SAVE_FIX, LARGEST_PICTURE)
    return read_npz(path, _SAVE_FIX, [name], LARGEST_PICTURE)[name]


def _header(file: IO[bytes], path: Path) -> ArrayHeader:
    version = np.lib.format.read_magic(file)
    shape, _, dtype = _HEADERS.get(version, np.lib.format.read_array_header_2_0)(file)  # 3.0 is 2.0 in UTF-8
    if dtype.hasobject:
        fix = "Save numbers with numpy.save, and other data as JSON."
        raise PlgsError("pickled", "this is a pickled array, which could run code when it is read", path, fix)
    if float(np.prod(shape, dtype=np.float64)) * dtype.itemsize > LARGEST_PICTURE:  # int64 could overflow
        sides = " x ".join(map(str, shape))
        what = f"an array of {sides} numbers is too large for a picture"
        raise PlgsError("array-too-large", what, path, "Save one frame per file.")
    return ArrayHeader(tuple(shape), dtype.kind)
