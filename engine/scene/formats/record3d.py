"""Record3D's ``.r3d``: a zip of ``metadata``, ``rgbd/N.jpg``, ``rgbd/N.depth`` and ``rgbd/N.conf``; or it unpacked.

``metadata`` is JSON: ``K`` (column by column) for pictures of ``w`` x ``h``, or ``perFrameIntrinsicCoeffs`` (fx fy cx
cy); ``poses`` (qx qy qz qw tx ty tz), camera-to-world, OpenGL axes, metres; ``dw`` and ``dh``, the size of depth.
Depth is LZFSE of float32 metres, confidence LZFSE of bytes 0 to 2; the lowest is dropped. LZFSE needs the package
pyliblzfse.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from ...gates import read_plain, refuse_special
from ..camera import Camera
from ..frame import SceneError, Size
from ..json_file import parse_json_object, take_list, take_matrix, take_number
from ..matrices import UpAxis, placed
from ..pixels import decode_bytes, resize_colour, resize_nearest
from ..upright import upright_rotation
from .capture import Capture, Shot
from .confidence import drop_untrusted
from .lzfse_blocks import unpack
from .poses import from_opengl, quaternion_pose

LOOKS_FOR = "a .r3d file, or metadata with the folder rgbd"
_FIX = "Export it from Record3D again."
_LARGEST = 2**28
"""Bytes of one picture or depth map, unpacked."""
_DEPTH_SIZES = ((192, 256), (256, 192), (480, 640), (640, 480))
"""LiDAR and TrueDepth, upright and lying, where the metadata does not say."""
_MOST_DEPTHS = 2**22
"""Numbers of a depth map."""
_CLEARLY_Y = 0.9
"""Cosine of 25 degrees."""


@dataclass(frozen=True)
class _Archive:
    """A .r3d, or the folder that it was unpacked to."""

    path: Path

    def names(self) -> list[str]:
        if self.path.is_dir():
            return [f"rgbd/{each.name}" for each in (self.path / "rgbd").iterdir()]
        with self._open() as archive:
            return archive.namelist()

    def read(self, name: str) -> bytes:
        """Raises SceneError."""
        if self.path.is_dir():
            try:
                return read_plain(self.path / name, _LARGEST)
            except OSError as error:
                raise SceneError(f"the file cannot be read ({error.strerror})", self.path / name, _FIX) from error
        with self._open() as archive:
            try:
                if archive.getinfo(name).file_size > _LARGEST:
                    raise SceneError(f"{name} is too large", self.path, _FIX)
                return archive.read(name)
            except KeyError as error:
                raise SceneError(f"{name} is missing", self.path, _FIX) from error
            except (BadZipFile, OSError, ValueError, NotImplementedError, RuntimeError, EOFError) as error:
                raise SceneError(f"{name} cannot be unpacked", self.path, _FIX) from error

    def _open(self) -> ZipFile:
        try:
            refuse_special(self.path)
            return ZipFile(self.path)
        except (BadZipFile, OSError, ValueError, NotImplementedError) as error:
            raise SceneError("this is no .r3d file, or it is cut off", self.path, _FIX) from error


def recognises(place: Path) -> bool:
    if place.is_file():
        return place.suffix.lower() == ".r3d"
    return _find(place) is not None


def _find(place: Path) -> Path | None:
    """The archive that is meant: the place itself, or the only one in it."""
    if place.is_file() or ((place / "metadata").is_file() and (place / "rgbd").is_dir()):
        return place
    found = [path for path in place.glob("*.r3d") if path.is_file()]
    return found[0] if len(found) == 1 else None


def read(place: Path) -> Capture:
    """Open the frames; no picture is decoded. Raises SceneError."""
    path = _find(place)
    if path is None:
        raise SceneError("there is no .r3d file, or more than one", place, "Name the file.")
    archive = _Archive(path)
    metadata = parse_json_object(archive.read("metadata"), path)
    count = len(take_list(metadata, "poses", "metadata", path))
    poses = take_matrix(metadata, "poses", "metadata", path, ((count, 7),))
    names = {*archive.names()}
    numbers = sorted(int(match[1]) for name in names if (match := re.fullmatch(r"rgbd/(\d+)\.jpg", name)))
    if not numbers or numbers[-1] >= count:
        raise SceneError(f"there are {count} poses and {len(numbers)} pictures", path, _FIX)
    shots, lost = [], []
    for number in numbers:
        if not np.isfinite(poses[number]).all():
            lost.append(str(number))
            continue
        qx, qy, qz, qw, *position = poses[number].tolist()
        pose = from_opengl(quaternion_pose((qw, qx, qy, qz), position, path))
        camera = placed(_lens(metadata, number, path), pose)
        size = (int(metadata["dw"]), int(metadata["dh"])) if _has_depth_size(metadata) else None
        has_depth = f"rgbd/{number}.depth" in names
        conf = f"rgbd/{number}.conf"
        depth = _DepthReader(archive, f"rgbd/{number}.depth", conf if conf in names else None, size, camera)
        shots.append(
            Shot(
                name=str(number),
                camera=camera,
                colour_path=path,
                read_colour=_ColourReader(archive, f"rgbd/{number}.jpg"),
                depth_path=path if has_depth else None,
                read_depth=depth if has_depth else None,
                file_shows_colour=False,
            )
        )
    return Capture(tuple(shots), _up(shots), tuple(lost))


def _up(shots: list[Shot]) -> UpAxis | None:
    """ARKit's y, unless the cameras stand otherwise: some recordings count from their first pose."""
    up = upright_rotation([shot.camera.camera_to_world for shot in shots])[2] if shots else np.zeros(3)
    return "y" if up[1] > _CLEARLY_Y else None


def _has_depth_size(metadata: dict[str, Any]) -> bool:
    return all(isinstance(metadata.get(key), int) and 0 < metadata[key] < 2**14 for key in ("dw", "dh"))


def _lens(metadata: dict[str, Any], number: int, path: Path) -> Camera:
    """A picture's camera at the origin; the file does not say where pixels are counted from: their corners."""
    width, height = (take_number(metadata, key, "metadata", path) for key in "wh")
    each = metadata.get("perFrameIntrinsicCoeffs")
    if isinstance(each, list) and len(each) > number:
        own = {"coefficients": [each[number][:4]] if isinstance(each[number], list) else each[number : number + 1]}
        fx, fy, cx, cy = take_matrix(own, "coefficients", f"frame {number}", path, ((1, 4),))[0].tolist()
    else:
        K = take_matrix({"K": [metadata.get("K")]}, "K", "metadata", path, ((1, 9),))[0].tolist()
        fx, fy, cx, cy = K[0], K[4], K[6], K[7]
    if not (0.0 < fx < 1e6 and 0.0 < fy < 1e6 and 0.0 <= cx <= width < 2**16 and 0.0 <= cy <= height < 2**16):
        raise SceneError(f"frame {number} has intrinsics that no camera has", path, _FIX)
    return Camera(round(width), round(height), fx, fy, cx, cy, np.eye(4))


@dataclass(frozen=True)
class _ColourReader:
    """Reads one picture of an archive."""

    archive: _Archive
    name: str

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB at ``size`` (width, height) or its own. Raises SceneError."""
        pixels = decode_bytes(self.archive.read(self.name), self.archive.path, as_colour=True)
        return resize_colour(pixels, size) if size else pixels


@dataclass(frozen=True, eq=False)
class _DepthReader:
    """Reads one depth map of an archive; ``size`` is None where the metadata does not say it."""

    archive: _Archive
    name: str
    confidence: str | None
    size: Size | None
    camera: Camera

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none. Raises SceneError."""
        width, height = self.size or max(_DEPTH_SIZES)
        values = np.frombuffer(self._unpacked(self.name, 4, min(width * height, _MOST_DEPTHS)), "<f4")
        width, height = self.size or self._guessed_size(len(values))
        if width * height != len(values):
            raise SceneError(f"{self.name} does not hold {width}x{height} numbers", self.archive.path, _FIX)
        depth = values.reshape(height, width)
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))
        if self.confidence is not None:
            level = np.frombuffer(self._unpacked(self.confidence, 1, depth.size), np.uint8)
            if len(level) == depth.size:
                depth = drop_untrusted(depth, level.reshape(depth.shape), self.archive.path)
        return resize_nearest(depth, size) if size else depth

    def _guessed_size(self, count: int) -> Size:
        """Which of the sensors' sizes has so many pixels, lying or upright as the picture is. Raises SceneError."""
        upright = self.camera.height > self.camera.width
        found = [size for size in _DEPTH_SIZES if size[0] * size[1] == count and (size[1] > size[0]) is upright]
        if not found:
            raise SceneError(f"{self.name} has a size that is not known", self.archive.path, _FIX)
        return found[0]

    def _unpacked(self, name: str, step: int, most: int) -> bytes:
        """The bytes, whole steps of them, ``most`` at most. Raises SceneError."""
        data = self.archive.read(name)
        try:
            import liblzfse
        except ImportError as error:
            fix = "Let the engine's Python install it: python -m pip install -r requirements/readers.txt."
            raise SceneError("depth of Record3D needs the package pyliblzfse", self.archive.path, fix) from error
        try:
            unpacked = unpack(data, most * step, liblzfse.decompress)
        except (liblzfse.error, ValueError, MemoryError) as error:
            raise SceneError(f"{name} cannot be decompressed ({error})", self.archive.path, _FIX) from error
        if len(unpacked) % step:
            raise SceneError(f"{name} is cut off", self.archive.path, _FIX)
        return unpacked
