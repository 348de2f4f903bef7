"""ScanNet's folders, which Panoptic Lifting's prepared scenes have as well, and its ``.sens``.

Folders ``color/ depth/ pose/ intrinsic/``:

* ``color/<name>.jpg`` or ``.png``; the names are the frames, in natural order.
* ``depth/<name>.png``, 16 bits, millimetres along the optical axis, 0 = none; of any size with the colour's shape. The
  folder may be missing.
* ``pose/<name>.txt``, camera-to-world, 4x4, OpenCV axes, metres. A pose with inf (lost tracking) drops the frame.
* ``intrinsic/intrinsic_color.txt``, 3x3 or 4x4, in pixels of the colour images with integer pixel centres. It belongs
  to the size that most colour images have (at a tie, to the first's) and is scaled for frames of another size and the
  same shape. ``intrinsic/<name>.txt`` overrides it for one frame. ScanNet's ``frames_25k`` have
  ``intrinsics_color.txt`` beside the folders instead, in pixels of each picture.
* ``intrinsic/intrinsic_depth.txt`` or ``intrinsics_depth.txt``, optional: the depth's own lens in its images' pixels.
* ``intrinsic/extrinsic_depth.txt``, optional, 4x4: from points of the depth camera to points of the colour camera.
* ``splits.json``, optional: ``{"train": [...], "test": [...]}``; frames that it leaves out need no depth.

The ``.sens`` is one file with a header, then frames of a pose, a JPEG or PNG, and compressed depth.
Camera-to-world, OpenCV axes, metres, z up; -inf when tracking was lost. Colour and depth have intrinsics, with integer
pixel centres, and extrinsics; depth is planar, 16 bits, ``depth_shift`` steps per metre. Frames are named by their
number, as ScanNet's labels are."""

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

from ...errors import PlgsError, reading
from ...gates import open_plain
from ...job.progress import part_of
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import shown_files
from ...posed.matrices import read_intrinsics
from ...posed.plain_folders import NAME, read_folders, recognises
from ..depth import DepthMap, between_cameras, fault_of, fitting_alignment, open_depth, seen_by_colour
from ..pixels import decode_bytes
from .capture import Capture, Progress, SceneFormat, Shot, only_file, watched
from .lens import pinhole
from .poses import finite_pose


def _read_folders(folder: Path, progress: Progress) -> Capture:
    has_own, beside = any(shown_files(folder / "intrinsic", "*.txt")), folder / "intrinsics_color.txt"
    lens_of = lambda picture: read_intrinsics(beside, read_image_header(picture).size)  # noqa: E731
    own, rest = part_of(progress, 0.0, 0.7), part_of(progress, 0.7, 1.0)
    found = read_folders(folder, None if has_own or not beside.is_file() else lens_of, own)
    depths, inferred = open_depth(folder, found.cameras, rest) if (folder / "depth").is_dir() else ({}, ())
    shots = {name: Shot(name, camera, found.pictures[name], depths.get(name)) for name, camera in found.cameras.items()}
    faults = {name: fault_of(path) for name, path in found.pictures.items() if name not in shots}
    found_as, lost = ((name, shots.get(name) or faults.get(name)) for name in found.names), {*found.lost}
    kept = [(name, shot) for name, shot in found_as if shot is not None or name in lost]
    return Capture(kept, "z", split=found.split, inferred=inferred)


FOLDERS = SceneFormat(NAME, recognises, _read_folders)


_VERSION = 4
_COLOURS = (1, 2)  # PNG and JPEG
_RAW, _ZLIB = 0, 1
_FIX = "Copy or download this file again."
_LARGEST_NAME = 10_000


@dataclass(frozen=True, eq=False)
class _Header:
    """The header of a .sens. Its lenses are cameras at the origin; ``unit`` is a depth value's unit in metres.
    ``beside``: see ``between_cameras``."""

    colour: Camera
    depth: Camera
    depth_compression: int
    unit: float
    frames: int
    beside: NDArray[np.float64]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Block:
    """The ``size`` bytes from ``start`` on in the file ``path``."""

    path: Path
    start: int
    size: int

    def read(self) -> bytes:
        with reading(self.path), open_plain(self.path) as file:
            file.seek(self.start)
            data = file.read(self.size)
        if len(data) < self.size:
            raise PlgsError("cut-off", "the file is cut off", self.path, _FIX)
        return data


def _read_sens(place: Path, progress: Progress) -> Capture:
    path = only_file(place, ".sens")
    if path is None:
        raise PlgsError("not-one-file", "there is no .sens file, or more than one", place, "Name a .sens file.")
    with open_plain(path) as file:
        header = _read_header(file, path)
        fits = fitting_alignment(header.colour, header.depth) is not None
        found = list(_shots(file, path, header, progress))
    ignored = "the depth camera's intrinsics do not fit the colour camera's and are ignored"
    return Capture(found, "z", header.warnings if fits else (*header.warnings, ignored))


def _shots(file: BinaryIO, path: Path, header: _Header, progress: Progress) -> Iterator[tuple[str, Shot | None]]:
    end = path.stat().st_size
    for number in watched(range(header.frames), progress):
        name = str(number)
        matrix = np.array(_take(file, "<16f", path)).reshape(4, 4)
        colour_size, depth_size = (int(size) for size in _take(file, "<QQQQ", path)[2:])  # after two time stamps
        start = file.tell()
        if colour_size + depth_size > end - start:
            raise PlgsError("cut-off", "the file is cut off", path, _FIX)
        colour, depth = _Block(path, start, colour_size), _Block(path, start + colour_size, depth_size)
        file.seek(start + colour_size + depth_size)
        pose = finite_pose(matrix, path)
        measured = DepthMap(path, partial(_read_depth, depth, header))
        depth_map = seen_by_colour(measured, header.depth, header.colour, header.beside) or measured
        picture = partial(_read_colour, colour)
        yield name, None if pose is None else Shot(name, header.colour.at(pose), path, depth_map, picture)


def _read_header(file: BinaryIO, path: Path) -> _Header:
    (version,) = _take(file, "<I", path)
    if version != _VERSION:
        raise PlgsError("not-sens", f"this is not a .sens of version {_VERSION}", path, "Give ScanNet's own file.")
    (length,) = _take(file, "<Q", path)
    if length > _LARGEST_NAME:
        raise PlgsError("not-sens", "this is not a .sens file", path, "Give ScanNet's own file.")
    _take(file, f"<{int(length)}x", path)  # the sensor's name
    matrices = np.array(_take(file, "<64f", path), np.float64).reshape(4, 4, 4)  # colour's lens and pose, then depth's
    colour_compression, depth_compression = _take(file, "<ii", path)
    colour_width, colour_height, depth_width, depth_height = _take(file, "<IIII", path)
    shift, frames = _take(file, "<fQ", path)
    if colour_compression not in _COLOURS or depth_compression not in (_RAW, _ZLIB):
        fix = "Export it with ScanNet's SensReader, and name the folder."
        raise PlgsError("unknown-codec", "colour or depth is compressed in a way that is not known", path, fix)
    if not 0.0 < shift < 1e6 or max(depth_width, depth_height) > 2**14:
        raise PlgsError("bad-header", "the header of this .sens file is invalid", path, _FIX)
    beside, warnings = between_cameras(matrices[3], matrices[1])
    return _Header(
        colour=_lens(colour_width, colour_height, matrices[0], path),
        depth=_lens(depth_width, depth_height, matrices[2], path),
        depth_compression=int(depth_compression),
        unit=1.0 / shift,
        frames=int(frames),
        beside=beside,
        warnings=warnings,
    )


def _lens(width: float, height: float, K: NDArray[np.float64], path: Path) -> Camera:
    """Return a camera at the origin from an intrinsic matrix, float64 [4, 4], with integer pixel centres."""
    return pinhole(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, path=path, fix=_FIX)


def _take(file: BinaryIO, layout: str, path: Path) -> tuple[float, ...]:
    """Read the next values; ``layout`` is a format of ``struct``. Raises PlgsError if the file ends before."""
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) < size:
        raise PlgsError("cut-off", "the file is cut off", path, _FIX)
    return struct.unpack(layout, data)


def _read_colour(block: _Block) -> NDArray[np.uint8]:
    return decode_bytes(block.read(), block.path, as_colour=True)


def _read_depth(block: _Block, header: _Header) -> NDArray[np.float32]:
    """Read planar depth, float32 [H, W] metres, 0 = none."""
    width, height = header.depth.size
    data, wanted = block.read(), 2 * width * height
    if header.depth_compression == _ZLIB:
        try:
            data = zlib.decompressobj().decompress(data, wanted)  # zlib.decompress has no limit of size
        except zlib.error as error:
            raise PlgsError("depth-damaged", "depth cannot be decompressed", block.path, _FIX) from error
    if len(data) != wanted:
        raise PlgsError("other-size", "depth does not have the size that the header says", block.path, _FIX)
    return np.frombuffer(data, "<u2").reshape(height, width) * np.float32(header.unit)


SENS = SceneFormat("sens", lambda place: only_file(place, ".sens") is not None, _read_sens)
