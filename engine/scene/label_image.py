"""Pictures of ids: PNGs (grey, or a palette's indices), or arrays in .npy and .npz files."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.array_file import array_headers, read_array
from ..posed.image_header import ImageHeader, check_image_file, read_image_header
from ..posed.limits import LARGEST_PIXELS
from .frame import Size
from .pixels import decode_bytes

SUFFIXES = {".png", ".npy", ".npz"}
_LARGEST_ID = 2**24


def label_map_size(path: Path) -> Size:
    """(width, height); only the header is read. Raises PlgsError unless it is a picture of ids."""
    if path.suffix.lower() == ".png":
        return label_header(path).size
    shape = array_headers(path)[_only_array(path)].shape
    if len(shape) != 2 or 0 in shape:
        raise PlgsError("this is not a picture of ids", path, "Save an array [height, width] of whole numbers.")
    return shape[1], shape[0]


def label_header(path: Path) -> ImageHeader:
    """The header of a PNG with one channel, palettes included. Raises PlgsError."""
    header = read_image_header(path)
    if header.format != "png" or header.channels != 1:
        fix = "Save the ids themselves as grey values, or as indices of a palette."
        raise PlgsError("a label image must be a PNG with one channel, not colours", path, fix)
    if header.width * header.height > LARGEST_PIXELS:
        raise PlgsError(f"{header.width}x{header.height} is too large for a mask", path, "Write this file again.")
    return header


def check_label_header(path: Path) -> Size:
    """(width, height) of a grey PNG of 8 or 16 bits. Raises PlgsError for palettes and others."""
    header = read_image_header(path)
    if header.format != "png" or header.channels != 1 or header.palette or header.bit_depth < 8:
        what = "a label image must be a PNG with one channel of 8 or 16 bits, without a palette"
        raise PlgsError(what, path, "Save the ids themselves as grey values.")
    return header.size


def read_label_map(path: Path) -> NDArray[np.int64]:
    """The ids as stored, int64 [H, W]; they may be negative in an array. Raises PlgsError."""
    if path.suffix.lower() == ".png":
        return read_indices(path).astype(np.int64)
    label_map_size(path)
    return whole_numbers(read_array(path, _only_array(path)), path)


def whole_numbers(values: NDArray[np.generic], path: Path) -> NDArray[np.int64]:
    """Ids as int64, also from floats that are whole numbers. Raises PlgsError."""
    numbers = values.astype(np.int64) if values.dtype.kind in "biu" else None
    if values.dtype.kind == "f" and np.isfinite(values).all() and bool((values == np.floor(values)).all()):
        numbers = values.astype(np.int64)
    if numbers is None or int(np.abs(numbers).max(initial=0)) > _LARGEST_ID:
        raise PlgsError("these are not ids", path, f"Save whole numbers from 0 to {_LARGEST_ID}.")
    return numbers


def _only_array(path: Path) -> str:
    names = list(array_headers(path))
    if len(names) != 1:
        raise PlgsError(f"there are {len(names)} arrays in one file", path, "Save only the picture of ids.")
    return names[0]


def read_indices(path: Path) -> NDArray[np.int32]:
    """A one-channel PNG's values, int32 [H, W]; with a palette, its indices and not its colours. Raises PlgsError."""
    header = label_header(path)
    data = check_image_file(path)
    if header.palette:
        data = _as_grey(data)
    pixels = decode_bytes(data, path, as_colour=False)
    if pixels.ndim != 2:
        raise PlgsError("a label image must have one channel, not colours", path, "Save the ids as grey values.")
    if header.bit_depth < 8:  # decoders stretch 1, 2 and 4 bits over the range of a byte
        pixels = pixels // (255 // (2**header.bit_depth - 1))
    return pixels.astype(np.int32)


def _as_grey(data: bytes) -> bytes:
    """The same PNG without its palette, so that its indices are grey values."""
    kept, position = [data[:8]], 8
    while position + 12 <= len(data):
        end = position + 12 + int.from_bytes(data[position : position + 4], "big")
        kind, chunk = data[position + 4 : position + 8], data[position:end]
        if kind == b"IHDR":
            body = chunk[4:17] + b"\0" + chunk[18:21]  # colour type 3 becomes 0
            chunk = chunk[:4] + body + zlib.crc32(body).to_bytes(4, "big")
        if kind in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(chunk)
        position = end
    return b"".join(kept)
