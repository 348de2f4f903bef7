"""Decode and resize pictures. Pictures of ids are PNGs (grey, or a palette's indices), or arrays in .npy and .npz."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job.atomic import write_atomically
from ..posed.array_file import array_headers, read_array
from ..posed.image_header import ImageHeader, check_image_bytes, check_image_file, png_chunks, read_image_header
from ..posed.layout import LARGEST_PIXELS
from .frame import Size
from .values import checked_ids, inside


@dataclass(frozen=True)
class Alignment:
    """Maps a point of the colour image to the depth image, as fractions of their widths and heights: depth_x = x_scale
    * colour_x + x_shift, and y likewise. It is the identity unless the depth camera has its own lens."""

    x_scale: float = 1.0
    x_shift: float = 0.0
    y_scale: float = 1.0
    y_shift: float = 0.0


def decode(path: Path, as_colour: bool) -> NDArray[Any]:
    """Decode an image as uint8 [H, W, 3] RGB, or as it is stored (RGB order), uint8 or uint16 [H, W] or [H, W, C].
    Orientation tags are ignored, as intrinsics refer to the stored pixels. Raises PlgsError for a damaged file."""
    return decode_bytes(check_image_file(path), path, as_colour)


def opaque(path: Path) -> NDArray[np.bool_]:
    """Return where an image with alpha is not fully transparent, bool [H, W]. Raises PlgsError if it is damaged."""
    return np.asarray(decode(path, as_colour=False)[..., 3] > 0)


def decode_bytes(data: bytes, path: Path, as_colour: bool) -> NDArray[Any]:
    """Decode an image's bytes, which come from ``path``, as ``decode`` does. Raises PlgsError if they are damaged."""
    import cv2

    check_image_bytes(data, path)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if as_colour else cv2.IMREAD_UNCHANGED
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError) as error:
        reason = getattr(error, "err", "no memory is left for it")
        raise PlgsError("undecodable", f"the image cannot be decoded ({reason})", path, "Write it again.") from error
    if pixels is None:
        raise PlgsError("undecodable", "the image cannot be decoded", path, "Write this file again.")
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return pixels


def write_image(path: Path, rgb: NDArray[Any]) -> None:
    """Write uint8 [H, W, 3] as JPEG or PNG, by the suffix. Raises PlgsError if it cannot be encoded, OSError."""
    write_atomically(path, image_bytes(rgb, path.suffix, str(path)))


def image_bytes(
    pixels: NDArray[Any], suffix: str = ".png", where: str = "a picture", ways: Sequence[int] = ()
) -> bytes:
    """Encode RGB or RGBA uint8 [H, W, 3 or 4], or ids [H, W] of 8 or 16 bits, as PNG, or as JPEG of the quality 95.
    ``ways`` are OpenCV's encoding flags and their values; ``where`` is for errors. Raises PlgsError if that fails."""
    import cv2

    stored = np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[-1]]] if pixels.ndim == 3 else pixels)  # BGR
    good, data = cv2.imencode(suffix, stored, ways)
    if not good:
        fix = "Check the size of the scene's pictures."
        raise PlgsError("unencodable", "the picture cannot be encoded", where, fix)
    return data.tobytes()


def largest_of_16_bits(path: Path) -> int | None:
    """Return the largest colour value of a 16-bit PNG without alpha, else None. Raises PlgsError for damage."""
    if read_image_header(path).bit_depth != 16:
        return None
    pixels = decode(path, as_colour=False)
    return int((pixels if pixels.ndim == 2 else pixels[..., :3]).max())


@dataclass(frozen=True, eq=False)
class ColourReader:
    """Reads a picture with ``read`` (uint8 [H, W, 3] RGB at its own size) and resizes it."""

    read: Callable[[], NDArray[np.uint8]]

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """Read uint8 [H, W, 3] RGB at ``size`` (width, height), or at its own size. Raises what ``read`` raises."""
        pixels = self.read()
        return resize_colour(pixels, size) if size else pixels


def decode_depth(path: Path, fix: str) -> NDArray[Any]:
    """Decode a depth picture, uint8 or uint16 [H, W] as stored; many tools write grey as three equal channels. Raises
    PlgsError for colours, with ``fix`` as the advice."""
    pixels = equal_channels(decode(path, as_colour=False))
    if pixels is None:
        raise PlgsError("depth-colours", "a depth map must have one channel, not colours", path, fix)
    return pixels


def equal_channels(pixels: NDArray[Any]) -> NDArray[Any] | None:
    """Return a picture's grey values [H, W] if it has one channel, or equal channels except alpha; otherwise None."""
    if pixels.ndim == 2:
        return pixels
    are_equal = bool((pixels[..., :3] == pixels[..., :1]).all())
    return np.ascontiguousarray(pixels[..., 0]) if are_equal else None  # a view would keep all channels in memory


def resize_colour(pixels: NDArray[np.uint8], size: Size) -> NDArray[np.uint8]:
    """Resize uint8 [H, W, 3]: area averages to shrink, Lanczos to enlarge."""
    height, width = pixels.shape[:2]
    if (width, height) == size:
        return pixels
    import cv2

    shrinks = size[0] < width or size[1] < height
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LANCZOS4)  # type: ignore[return-value]


def resize_nearest(pixels: NDArray[Any], size: Size) -> NDArray[Any]:
    """Resize [H, W] to ``size`` (width, height) without mixing values. Returns the same array if the size is right."""
    height, width = pixels.shape
    if (width, height) == size:
        return pixels
    rows, columns = nearest_pixels((width, height), size)
    return pixels[rows[:, None], columns]


def nearest_pixels(stored: Size, size: Size) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which row of a picture of size ``stored`` (width, height) each row of one of ``size`` shows, int64 [rows],
    and likewise the columns, int64 [columns]."""
    centres = ((2 * np.arange(new) + 1) * old // (2 * new) for old, new in zip(stored, size, strict=True))
    columns, rows = centres  # in exact whole numbers
    return rows, columns


def resize_aligned(pixels: NDArray[Any], size: Size, alignment: Alignment) -> NDArray[Any]:
    """Map [H, W] into the colour image's pixels at ``size`` without mixing values; 0 beyond the source."""
    if alignment == Alignment():
        return resize_nearest(pixels, size)
    height, width = pixels.shape
    x = (alignment.x_scale * (np.arange(size[0]) + 0.5) / size[0] + alignment.x_shift) * width
    y = (alignment.y_scale * (np.arange(size[1]) + 0.5) / size[1] + alignment.y_shift) * height
    columns, rows = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    taken = pixels[rows.clip(0, height - 1)[:, None], columns.clip(0, width - 1)]
    return np.where(inside, taken, taken.dtype.type(0))


def values_at(pixels: NDArray[Any], places: NDArray[np.float64]) -> NDArray[Any]:
    """Return the values of an array [H, W] at ``places``, float64 [N, 2], x and y as fractions of its size."""
    size = np.array(pixels.shape[::-1])
    columns, rows = (places * size).astype(np.int64).clip(0, size - 1).T
    return pixels[rows, columns]


def distinct_ids(ids: NDArray[np.int32] | NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The distinct values (>= 0) of an array, ascending, void (0) included, and the number of pixels of each, [n]."""
    # Counting is faster than sorting, unless the table is much larger than the picture.
    if int(ids.max(initial=0)) > ids.size + 65536:
        values, counts = np.unique(ids, return_counts=True)
        return values.astype(np.intp), counts
    counts = np.bincount(ids.ravel())
    values = np.flatnonzero(counts)
    return values, counts[values]


def numbered_labels(labels: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.intp]]:
    """Return the distinct values of a picture of labels, ascending, and the index of each pixel's value among them,
    [N]. It returns the same as ``numpy.unique``, but sorts only one value of each run of equal pixels."""
    flat = labels.ravel()
    starts = np.flatnonzero(np.append(len(flat) > 0, flat[1:] != flat[:-1]))
    values, index = np.unique(flat[starts], return_inverse=True)
    return values, np.repeat(index, np.diff(starts, append=len(flat)))


SUFFIXES = {".png", ".npy", ".npz"}
_LARGEST_ID = 2**24
_NEARLY = 12  # steps of 8 bits by which JPEG alters black and white


def label_map_size(path: Path) -> Size:
    """Return the (width, height) of a picture of ids from its header. Raises PlgsError for other files."""
    if path.suffix.lower() == ".png":
        return label_header(path).size
    shape = array_headers(path)[_only_array(path)].shape
    if len(shape) != 2 or 0 in shape:
        what = "this is not a picture of ids"
        raise PlgsError("not-ids", what, path, "Save an array [height, width] of whole numbers.")
    return shape[1], shape[0]


def label_header(path: Path) -> ImageHeader:
    """Return a header of a PNG of labels: one channel, a palette, or equal channels. Raises PlgsError for any other."""
    header = read_image_header(path)
    is_grey = header.channels == 1 or (header.format == "png" and equal_channels(decode(path, False)) is not None)
    if header.format != "png" or not is_grey:
        fix = "Save the ids themselves as grey values, or as indices of a palette."
        raise PlgsError("mask-colours", "a label image must be a PNG with one channel, not colours", path, fix)
    if header.width * header.height > LARGEST_PIXELS:
        what = f"{header.width}x{header.height} is too large for a mask"
        raise PlgsError("mask-too-large", what, path, "Write this file again.")
    return header


def check_label_header(path: Path) -> Size:
    """Return the (width, height) of an 8- or 16-bit grey PNG. Raises PlgsError for palettes and other files."""
    header = read_image_header(path)
    if header.format != "png" or header.channels != 1 or header.palette or header.bit_depth < 8:
        what = "a label image must be a PNG with one channel of 8 or 16 bits, without a palette"
        raise PlgsError("mask-png", what, path, "Save the ids themselves as grey values.")
    return header.size


def read_label_map(path: Path) -> NDArray[np.int64]:
    """Read ids as stored, int64 [H, W]; in an array they may be negative. Raises PlgsError for files without ids."""
    if path.suffix.lower() == ".png":
        ids = read_indices(path).astype(np.int64)
        return ids if label_header(path).palette else checked_ids(ids, path)
    label_map_size(path)  # only to raise for other shapes
    return whole_numbers(read_array(path, _only_array(path)), path)


def whole_numbers(values: NDArray[np.generic], path: Path) -> NDArray[np.int64]:
    """Return ids as int64 [...], also from floats that are whole numbers. Raises PlgsError for other values."""
    numbers = values.astype(np.int64) if values.dtype.kind in "biu" else None
    if values.dtype.kind == "f" and np.isfinite(values).all() and bool((values == np.floor(values)).all()):
        numbers = values.astype(np.int64)
    if numbers is None or int(np.abs(numbers).max(initial=0)) > _LARGEST_ID:
        raise PlgsError("not-ids", "the values are not ids", path, f"Save whole numbers from 0 to {_LARGEST_ID}.")
    return checked_ids(numbers, path)


def _only_array(path: Path) -> str:
    names = list(array_headers(path))
    if len(names) != 1:
        raise PlgsError("arrays", f"the mask holds {len(names)} arrays", path, "Save one array of ids.")
    return names[0]


def read_indices(path: Path) -> NDArray[np.int32]:
    """Read a one-channel PNG's values, int32 [H, W], or palette indices. Raises PlgsError for other files."""
    header = label_header(path)
    data = check_image_file(path)
    if header.palette:
        data = _as_grey(data)  # decoders replace indices by colours
    pixels = equal_channels(decode_bytes(data, path, as_colour=False))
    if pixels is None:
        what = "a label image must have one channel, not colours"
        raise PlgsError("mask-colours", what, path, "Save the ids as grey values.")
    if header.bit_depth < 8:  # decoders stretch 1, 2 and 4 bits over the range of a byte
        pixels = pixels // (255 // (2**header.bit_depth - 1))
    return pixels.astype(np.int32)


def shows_one_object(path: Path) -> bool:
    """Whether a PNG has one channel and two values, apart from soft edges. False if it cannot be read."""
    try:
        inside(values := read_indices(path), path)
    except PlgsError:
        return False
    return int(values.max(initial=0)) >= 128 or len(np.unique(values)) <= 2


def is_black_and_white(path: Path) -> bool:
    """Whether a one-channel PNG has only 0 and 255, apart from soft edges, and some 255. False if unreadable."""
    try:
        values = read_indices(path)
    except PlgsError:
        return False
    is_extreme = (values <= _NEARLY) | (values >= 255 - _NEARLY)
    return not label_header(path).palette and int(values.max(initial=0)) >= 255 - _NEARLY and is_extreme.mean() > 0.9


def _as_grey(data: bytes) -> bytes:
    """Return the same PNG without its palette, so that its indices are grey values."""
    kept = [data[:8]]
    for chunk in png_chunks(data):
        if chunk[4:8] == b"IHDR":
            body = chunk[4:17] + b"\0" + chunk[18:21]  # colour type 3 becomes 0
            chunk = chunk[:4] + body + zlib.crc32(body).to_bytes(4, "big")
        if chunk[4:8] in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(chunk)
    return b"".join(kept)
