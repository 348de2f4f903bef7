"""ScanNet's ``.sens``: one file with a header, then frames of a pose, a JPEG or PNG, and compressed depth.

Camera-to-world, OpenCV axes, metres, z up; -inf when tracking was lost. Intrinsics of colour and of depth, with
integer pixel centres; depth is planar, 16 bits, ``depth_shift`` steps per metre, and read through its own lens. Frames
are named by their number, as ScanNet's labels are.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import open_plain
from ...posed.camera import Camera
from ..depth import DepthMap, fitting_alignment
from ..pixels import Alignment, decode_bytes
from .capture import Capture, SceneFormat, Shot
from .lens import pinhole
from .poses import finite_pose

_VERSION = 4
_COLOURS = (1, 2)
"""PNG and JPEG."""
_RAW, _ZLIB = 0, 1
_FIX = "Copy or download this file again."
_LARGEST_NAME = 10_000


@dataclass(frozen=True, eq=False)
class _Header:
    """Lenses stand at the origin; ``unit`` is a step of depth in metres."""

    colour: Camera
    depth: Camera
    depth_compression: int
    unit: float
    frames: int


@dataclass(frozen=True)
class _Block:
    """Bytes in the file."""

    path: Path
    start: int
    size: int

    def read(self) -> bytes:
        """Raises PlgsError."""
        try:
            with open_plain(self.path) as file:
                file.seek(self.start)
                data = file.read(self.size)
        except OSError as error:
            fix = "Check that it exists."
            raise PlgsError(f"the file cannot be read ({error.strerror})", self.path, fix) from error
        if len(data) < self.size:
            raise PlgsError("the file is cut off", self.path, _FIX)
        return data


def _recognises(place: Path) -> bool:
    return _find(place) is not None


def _find(place: Path) -> Path | None:
    """The .sens file that is meant: the place itself, or the only one in it."""
    if place.is_file():
        return place if place.suffix.lower() == ".sens" else None
    found = [path for path in place.glob("*.sens") if path.is_file()]
    return found[0] if len(found) == 1 else None


def _read(place: Path) -> Capture:
    """Open the frames; no picture is decoded. Raises PlgsError."""
    path = _find(place)
    if path is None:
        raise PlgsError("there is no .sens file, or more than one", place, "Name the file.")
    with open_plain(path) as file:
        header = _read_header(file, path)
        alignment = fitting_alignment(header.colour, header.depth)
        found = list(_shots(file, path, header, alignment or Alignment()))
    ignored = "the depth camera's intrinsics do not fit the colour camera's and are ignored"
    return Capture(found, "z", () if alignment else (ignored,))


def _shots(file: BinaryIO, path: Path, header: _Header, alignment: Alignment) -> Iterator[tuple[str, Shot | None]]:
    end = path.stat().st_size
    for number in range(header.frames):
        name = str(number)
        matrix = np.array(_take(file, "<16f", path)).reshape(4, 4)
        colour_size, depth_size = (int(size) for size in _take(file, "<QQQQ", path)[2:])
        start = file.tell()
        if colour_size + depth_size > end - start:
            raise PlgsError("the file is cut off", path, _FIX)
        colour, depth = _Block(path, start, colour_size), _Block(path, start + colour_size, depth_size)
        file.seek(start + colour_size + depth_size)
        pose = finite_pose(matrix, path)
        depth_map = DepthMap(path, partial(_read_depth, depth, header), alignment)
        picture = partial(_read_colour, colour)
        yield name, None if pose is None else Shot(name, header.colour.at(pose), path, depth_map, picture)


def _read_header(file: BinaryIO, path: Path) -> _Header:
    (version,) = _take(file, "<I", path)
    if version != _VERSION:
        raise PlgsError(f"this is not a .sens of version {_VERSION}", path, "Give ScanNet's own file.")
    (length,) = _take(file, "<Q", path)
    if length > _LARGEST_NAME:
        raise PlgsError("this is not a .sens file", path, "Give ScanNet's own file.")
    _take(file, f"<{int(length)}x", path)
    matrices = np.array(_take(file, "<64f", path), np.float64).reshape(4, 4, 4)
    colour_compression, depth_compression = _take(file, "<ii", path)
    colour_width, colour_height, depth_width, depth_height = _take(file, "<IIII", path)
    shift, frames = _take(file, "<fQ", path)
    if colour_compression not in _COLOURS or depth_compression not in (_RAW, _ZLIB):
        fix = "Export it with ScanNet's SensReader, and name the folder."
        raise PlgsError("colour or depth is compressed in a way that is not known", path, fix)
    if not 0.0 < shift < 1e6 or max(depth_width, depth_height) > 2**14:
        raise PlgsError("the header makes no sense", path, _FIX)
    return _Header(
        colour=_lens(colour_width, colour_height, matrices[0], path),
        depth=_lens(depth_width, depth_height, matrices[2], path),
        depth_compression=int(depth_compression),
        unit=1.0 / shift,
        frames=int(frames),
    )


def _lens(width: float, height: float, K: NDArray[np.float64], path: Path) -> Camera:
    """A camera at the origin from a matrix, float64 [4, 4], with integer pixel centres."""
    return pinhole(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, path=path, fix=_FIX)


def _take(file: BinaryIO, layout: str, path: Path) -> tuple[float, ...]:
    """The next values, as ``struct`` calls them. Raises PlgsError."""
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) < size:
        raise PlgsError("the file is cut off", path, _FIX)
    return struct.unpack(layout, data)


def _read_colour(block: _Block) -> NDArray[np.uint8]:
    return decode_bytes(block.read(), block.path, as_colour=True)


def _read_depth(block: _Block, header: _Header) -> NDArray[np.float32]:
    """Planar depth, float32 [H, W] metres, 0 = none. Raises PlgsError."""
    width, height = header.depth.size
    data, wanted = block.read(), 2 * width * height
    if header.depth_compression == _ZLIB:
        try:
            data = zlib.decompressobj().decompress(data, wanted)
        except zlib.error as error:
            raise PlgsError("depth cannot be decompressed", block.path, _FIX) from error
    if len(data) != wanted:
        raise PlgsError("depth does not have the size that the header says", block.path, _FIX)
    return np.frombuffer(data, "<u2").reshape(height, width) * np.float32(header.unit)


FORMAT = SceneFormat("sens", _recognises, _read)
