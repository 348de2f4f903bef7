"""ScanNet's ``.sens``: one file with a header, then frames of a pose, a JPEG or PNG, and compressed depth.

Camera-to-world, OpenCV axes, metres, z up; -inf where tracking was lost. Intrinsics of colour and of depth, with
integer pixel centres; depth is planar, 16 bits, ``depth_shift`` steps a metre, and read through its own lens. Frames
are called by their number, as ScanNet's labels are.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...gates import open_plain
from ..camera import Camera
from ..depth import fitting_alignment
from ..frame import SceneError, Size
from ..matrices import placed
from ..pixels import Alignment, decode_bytes, resize_aligned, resize_colour
from .capture import Capture, Shot
from .poses import finite_pose

LOOKS_FOR = "a .sens file"
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
        """Raises SceneError."""
        try:
            with open_plain(self.path) as file:
                file.seek(self.start)
                data = file.read(self.size)
        except OSError as error:
            raise SceneError(
                f"the file cannot be read ({error.strerror})", self.path, "Check that it exists."
            ) from error
        if len(data) < self.size:
            raise SceneError("the file is cut off", self.path, _FIX)
        return data


def recognises(place: Path) -> bool:
    return _find(place) is not None


def _find(place: Path) -> Path | None:
    """The .sens file that is meant: the place itself, or the only one in it."""
    if place.is_file():
        return place if place.suffix.lower() == ".sens" else None
    found = [path for path in place.glob("*.sens") if path.is_file()]
    return found[0] if len(found) == 1 else None


def read(place: Path) -> Capture:
    """Open the frames; no picture is decoded. Raises SceneError."""
    path = _find(place)
    if path is None:
        raise SceneError("there is no .sens file, or more than one", place, "Name the file.")
    shots, lost = [], []
    end = path.stat().st_size
    with open_plain(path) as file:
        header = _read_header(file, path)
        alignment = fitting_alignment(header.colour, header.depth)
        for number in range(header.frames):
            matrix = np.array(_take(file, "<16f", path)).reshape(4, 4)
            colour_size, depth_size = (int(size) for size in _take(file, "<QQQQ", path)[2:])
            start = file.tell()
            if colour_size + depth_size > end - start:
                raise SceneError("the file is cut off", path, _FIX)
            colour, depth = _Block(path, start, colour_size), _Block(path, start + colour_size, depth_size)
            file.seek(start + colour_size + depth_size)
            pose = finite_pose(matrix, path)
            if pose is None:
                lost.append(str(number))
                continue
            size = (header.depth.width, header.depth.height)
            reader = _DepthReader(depth, size, header.depth_compression, header.unit, alignment or Alignment())
            camera = placed(header.colour, pose)
            shots.append(Shot(str(number), camera, path, _ColourReader(colour), path, reader, file_shows_colour=False))
    ignored = "the depth camera's intrinsics do not fit the colour camera's and are ignored"
    return Capture(tuple(shots), "z", tuple(lost), () if alignment else (ignored,))


def _read_header(file: BinaryIO, path: Path) -> _Header:
    (version,) = _take(file, "<I", path)
    if version != _VERSION:
        raise SceneError(f"this is no .sens of version {_VERSION}", path, "Give ScanNet's own file.")
    (length,) = _take(file, "<Q", path)
    if length > _LARGEST_NAME:
        raise SceneError("this is no .sens file", path, "Give ScanNet's own file.")
    _take(file, f"<{int(length)}x", path)
    matrices = np.array(_take(file, "<64f", path), np.float64).reshape(4, 4, 4)
    colour_compression, depth_compression = _take(file, "<ii", path)
    colour_width, colour_height, depth_width, depth_height = (int(side) for side in _take(file, "<IIII", path))
    shift, frames = _take(file, "<fQ", path)
    if colour_compression not in _COLOURS or depth_compression not in (_RAW, _ZLIB):
        fix = "Export it with ScanNet's SensReader, and name the folder."
        raise SceneError("colour or depth is compressed in a way that is not known here", path, fix)
    if not 0.0 < shift < 1e6 or max(depth_width, depth_height) > 2**14:
        raise SceneError("the header makes no sense", path, _FIX)
    return _Header(
        colour=_lens(matrices[0], (colour_width, colour_height), path),
        depth=_lens(matrices[2], (depth_width, depth_height), path),
        depth_compression=int(depth_compression),
        unit=1.0 / shift,
        frames=int(frames),
    )


def _lens(K: NDArray[np.float64], size: Size, path: Path) -> Camera:
    """A camera at the origin from a matrix, float64 [4, 4], with integer pixel centres."""
    (fx, cx), (fy, cy) = (K[0, 0], K[0, 2]), (K[1, 1], K[1, 2])
    width, height = size
    if not (fx > 0.0 and fy > 0.0 and 0.0 < cx + 0.5 < width and 0.0 < cy + 0.5 < height):
        raise SceneError("the intrinsics are those of no camera", path, _FIX)
    return Camera(width, height, float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5, np.eye(4))


def _take(file: BinaryIO, layout: str, path: Path) -> tuple[float, ...]:
    """The next values, as ``struct`` calls them. Raises SceneError."""
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) < size:
        raise SceneError("the file is cut off", path, _FIX)
    return struct.unpack(layout, data)


@dataclass(frozen=True)
class _ColourReader:
    """Reads one frame's picture out of the file."""

    block: _Block

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB. Raises SceneError."""
        pixels = decode_bytes(self.block.read(), self.block.path, as_colour=True)
        return resize_colour(pixels, size) if size else pixels


@dataclass(frozen=True)
class _DepthReader:
    """Reads one frame's depth out of the file, into the frame of its colour picture."""

    block: _Block
    size: Size
    compression: int
    unit: float
    alignment: Alignment

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none. Raises SceneError."""
        width, height = self.size
        data, wanted = self.block.read(), 2 * width * height
        if self.compression == _ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, wanted)
            except zlib.error as error:
                raise SceneError("depth cannot be decompressed", self.block.path, _FIX) from error
        if len(data) != wanted:
            raise SceneError("depth has another size than the header says", self.block.path, _FIX)
        steps = np.frombuffer(data, "<u2").reshape(height, width)
        return resize_aligned(steps, size or self.size, self.alignment) * np.float32(self.unit)
