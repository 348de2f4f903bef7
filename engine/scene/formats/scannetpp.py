"""ScanNet++'s iPhone captures: ``iphone/pose_intrinsic_imu.json`` beside the video and depth.

A frame has ``aligned_pose``, camera-to-world in the laser scan's frame, OpenCV axes, metres, z up, and ``intrinsic``,
3x3. Pictures are ``rgb/frame_000000.jpg`` if they were extracted, else frames of ``rgb.mp4`` or ``rgb.mkv``. Depth
is ``depth/frame_000000.png`` in millimetres if it was extracted, else ``depth.bin``, 256x192 per frame, planar: one raw
deflate stream of float32 metres; or for each frame 4 bytes of size (little endian), then an LZ4 block of 16-bit
millimetres or a raw deflate stream of float32 metres."""

from __future__ import annotations

import re
import zlib
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import open_plain
from ...json_file import read_json_object
from ...posed.image_header import read_image_header
from ...posed.layout import check_most, natural_order
from ...posed.matrices import take_array
from ..depth import DepthMap, fault_of, only_depth, png_depth
from ..files_of_frames import files_if_any
from .capture import Capture, Found, Progress, SceneFormat, Shot, watched
from .lens import pinhole
from .photos import Video
from .poses import finite_pose

_FIX = "Download the iPhone data of the scene again."
_TABLE = "pose_intrinsic_imu.json"
_WIDTH, _HEIGHT = 256, 192
_PIXELS = _WIDTH * _HEIGHT
_CHUNK = 1 << 16
_MOST_FRAMES = 1 << 19  # two hours at 60 frames a second


def _read(place: Path, progress: Progress) -> Capture:
    folder = place if (place / _TABLE).is_file() else place / "iphone"
    found, path = list[tuple[str, Found]](), folder / _TABLE
    table = read_json_object(path)
    pictures = files_if_any(folder / "rgb", {".jpg", ".png"}, _FIX)
    films = [path for path in (folder / "rgb.mp4", folder / "rgb.mkv") if path.is_file()]
    if not pictures and not films:
        raise PlgsError("no-pictures", "the pictures are missing", folder / "rgb.mkv", _FIX)
    video = None if pictures else Video(films[0])
    size = video.size() if video else None
    depths = files_if_any(folder / "depth", {".png"}, _FIX)
    stream = _DepthStream(folder / "depth.bin") if not depths and (folder / "depth.bin").is_file() else None
    for name in watched(sorted(table, key=natural_order), progress):
        match = re.fullmatch(r"frame_(\d+)", name)
        entry = table[name]
        if match is None or not isinstance(entry, dict):
            raise PlgsError("not-a-frame", f'"{name[:40]}" is not the name of a frame', path, _FIX)
        if pictures and name not in pictures:
            continue  # only some were extracted
        pose, number, picture = None, int(match[1]), video.path if video else pictures[name]
        if "aligned_pose" in entry:
            pose = finite_pose(take_array(entry, "aligned_pose", name, path, (4, 4)), path)
        fault = None if video or pose is None else fault_of(picture)
        if pose is None or fault is not None:
            found.append((name, fault))
            continue
        # The file does not say where pixels are counted from; corners are assumed.
        K, sides = take_array(entry, "intrinsic", name, path, (3, 3)), size or read_image_header(picture).size
        lens = pinhole(*sides, K[0, 0], K[1, 1], K[0, 2], K[1, 2], path=path, fix=_FIX, whose=name)
        depth = None
        if stream is not None:
            depth = DepthMap(stream.path, partial(stream.frame, number))
        elif name in depths:
            depth = png_depth(depths[name], lens)
        found.append((name, Shot(name, lens.at(pose), picture, depth, partial(video.frame, number) if video else None)))
    return Capture(found, "z", up_is_known=True, fps=video.fps() if video else None)


class _DepthStream:
    """The frames of a depth.bin. A single stream is unpacked forward; to read an earlier frame, it starts again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._blocks = _find_blocks(path)
        self._lock = Lock()  # threads that read frames share the stream's position
        self._file: BinaryIO | None = None
        self._unpacker: Any = None
        self._next = 0

    def frame(self, number: int) -> NDArray[np.float32]:
        """Read the depth of frame ``number``, float32 [192, 256] metres, 0 = none. Raises PlgsError without it."""
        try:
            if self._blocks is None:
                with self._lock:
                    return only_depth(self._from_stream(number))
            if number >= len(self._blocks):
                raise PlgsError("no-depth", f"frame {number} has no depth", self.path, _FIX)
            with open_plain(self.path) as file:
                file.seek(self._blocks[number][0])
                return only_depth(_unpack_block(file.read(self._blocks[number][1])))
        except (zlib.error, ValueError, OSError) as error:
            raise PlgsError("depth-damaged", f"depth of frame {number} cannot be unpacked", self.path, _FIX) from error

    def _from_stream(self, number: int) -> NDArray[np.float32]:
        if self._file is None or number < self._next:
            if self._file is not None:
                self._file.close()
            self._file = open_plain(self.path)
            self._unpacker, self._next = zlib.decompressobj(-zlib.MAX_WBITS), 0  # negative: a raw stream
        while True:
            depth = self._unpack(4 * _PIXELS)
            self._next += 1
            if self._next > number:
                return np.frombuffer(depth, "<f4").reshape(_HEIGHT, _WIDTH)

    def _unpack(self, size: int) -> bytes:
        """Unpack the next ``size`` bytes of the stream. Raises ValueError if it ends before."""
        assert self._file is not None
        parts, left = [], size
        while left:
            packed = self._unpacker.unconsumed_tail or self._file.read(_CHUNK)  # for which the last call had no room
            part = self._unpacker.decompress(packed, left)
            if not part and not packed:
                raise ValueError("the stream ends")
            parts.append(part)
            left -= len(part)
        return b"".join(parts)


def _find_blocks(path: Path) -> list[tuple[int, int]] | None:
    """Return the start and length of each frame's block; None if the sizes do not add up to the file's."""
    blocks: list[tuple[int, int]] = []
    end, start = path.stat().st_size, 0
    with open_plain(path) as file:
        while start < end:
            file.seek(start)
            length = int.from_bytes(file.read(4), "little")
            if not 0 < length <= 8 * _PIXELS or start + 4 + length > end:  # deflate never doubles floats
                return None
            blocks.append((start + 4, length))
            check_most(len(blocks), "frames", path, _FIX, _MOST_FRAMES)
            start += 4 + length
    return blocks


def _unpack_block(data: bytes) -> NDArray[np.float32]:
    """Decompress a frame's block. Raises ValueError, zlib.error."""
    import lz4.block

    try:
        steps = lz4.block.decompress(data, uncompressed_size=2 * _PIXELS)
    except lz4.block.LZ4BlockError:
        steps = b""  # not LZ4, so deflated floats
    if len(steps) == 2 * _PIXELS:
        return np.frombuffer(steps, "<u2").reshape(_HEIGHT, _WIDTH) * np.float32(0.001)
    metres = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, 4 * _PIXELS)
    return np.frombuffer(metres, "<f4").reshape(_HEIGHT, _WIDTH)


FORMAT = SceneFormat(
    "scannetpp", lambda place: any((each / _TABLE).is_file() for each in (place, place / "iphone")), _read
)
