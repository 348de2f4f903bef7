"""NumPy's .npy and .npz: never pickled, never larger than they may be, whatever their bytes say."""

from __future__ import annotations

import math
from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from ..gates import open_plain, read_plain
from .frame import SceneError

MOST_BYTES = 1 << 28
"""Unpacked, of all arrays of a file together: some five million labelled points."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(
    path: Path, fix: str, names: Collection[str] | None = None, most_bytes: int = MOST_BYTES
) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz by name: those of ``names``, or all. Raises SceneError, with ``fix`` as the advice, for what
    is damaged, missing, of objects, or would unpack to more than ``most_bytes``.
    """
    try:
        with open_plain(path) as file, ZipFile(file) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            wanted = {name: entries[name] for name in (entries if names is None else names)}
            size = sum(entry.file_size for entry in wanted.values())
            if size > most_bytes:
                what = f"it would unpack to {size / 1e6:.0f} MB, at most {most_bytes / 1e6:.0f} may be"
                raise SceneError(what, path, fix)
            return {name: parse_npy(archive.read(entry)) for name, entry in wanted.items()}
    except SceneError:
        raise
    except KeyError as error:
        raise SceneError(f"it has no array {error}", path, fix) from error
    except Exception as error:  # zip, deflate, a header that is Python: whatever they raise, these bytes are no arrays
        raise SceneError(f"the arrays cannot be read ({_reason(error)})", path, fix) from error


def read_npy(path: Path, fix: str, most_bytes: int = MOST_BYTES) -> NDArray[Any]:
    """The array of a .npy. Raises SceneError as ``read_npz`` does."""
    try:
        return parse_npy(read_plain(path, most_bytes))
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, fix) from error
    except Exception as error:
        raise SceneError(f"this is no NumPy array of numbers ({_reason(error)})", path, fix) from error


def parse_npy(data: bytes) -> NDArray[Any]:
    """The array that a .npy's bytes hold. What its header claims has to be there, before memory is taken for it.

    Raises ValueError, and whatever NumPy's parser of headers raises.
    """
    stream = BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"its version {version} is not known")
    shape, is_fortran, dtype = _HEADERS[version](stream)
    start = stream.tell()
    if dtype.hasobject or dtype.itemsize == 0:
        raise ValueError("it holds objects, not numbers")
    if math.prod(shape) * dtype.itemsize != len(data) - start or min(shape, default=0) < 0:
        raise ValueError(f"it does not hold the shape {shape} that it claims")
    values = np.frombuffer(bytearray(data), dtype, offset=start)
    return values.reshape(shape, order="F" if is_fortran else "C")


def _reason(error: Exception) -> str:
    """In one line."""
    return " ".join(str(error).split())[:100] or type(error).__name__
