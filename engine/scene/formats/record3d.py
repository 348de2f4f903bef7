"""Record3D's ``.r3d``: a zip of ``metadata``, ``rgbd/N.jpg``, ``rgbd/N.depth`` and ``rgbd/N.conf``; or these files.

``metadata`` is JSON: ``K`` (column by column) for pictures of ``w`` x ``h``, or ``perFrameIntrinsicCoeffs`` (fx fy cx
cy); ``poses`` (qx qy qz qw tx ty tz), camera-to-world, OpenGL axes, metres; ``dw`` and ``dh``, the size of depth.
Depth is LZFSE of float32 metres, confidence LZFSE of bytes 0 to 2; pixels with 0 are dropped. The library pyliblzfse
takes as much memory as a stream asks for, so ``unpack_lzfse`` bounds the first block's claim and the number of blocks.

Its export "EXR + JPG sequence" is a folder ``EXR_RGBD`` of ``metadata.json``, ``rgb/N.jpg`` or ``.png``, and
``depth/N.exr`` with metres in the channel R."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError, lacks_part
from ...gates import refuse_special
from ...json_file import parse_json_object, read_json_object, take_list, take_number
from ...posed.exr_header import read_exr_header
from ...posed.frames import Camera
from ...posed.layout import files_by_stem, read_file, shown_files
from ...posed.matrices import take_array, upright_rotation
from ..depth import DepthMap, drop_untrusted, fault_of, only_depth
from ..frame import Size
from ..pixels import decode_bytes
from .capture import Capture, Found, Progress, SceneFormat, Shot, only_file, watched
from .lens import pinhole
from .poses import from_opengl, quaternion_pose

_FIX = "Export it from Record3D again."
_EXPORTED = "metadata.json"
_LARGEST = 2**28  # maximum size in bytes of one unpacked picture or depth map
# (width, height) of LiDAR and TrueDepth, portrait and landscape, for metadata without a size.
_DEPTH_SIZES = ((192, 256), (256, 192), (480, 640), (640, 480))
_MOST_DEPTHS = 2**22  # maximum number of values in a depth map
_CLEARLY_Y = 0.9  # cosine of 25 degrees
_BLOCK = b"bvx"  # the mark at the beginning of each of LZFSE's blocks, none of which grows beyond 27 MB
_FULL_BLOCK = 10_000  # minimum bytes of all blocks but the last: they are full with 10 000 matches or 40 000 literals
_SHORTEST = 12  # bytes of the shortest stream: a block without content, and the end


@dataclass(frozen=True)
class _Archive:
    """A .r3d file, or the folder that it was unpacked to."""

    path: Path

    def names(self) -> list[str]:
        if self.path.is_dir():
            return [f"rgbd/{each.name}" for each in shown_files(self.path / "rgbd")]
        with self._open() as archive:
            return archive.namelist()

    def file(self, name: str) -> Path:
        """Return the file on disk that holds the entry ``name``: the archive, or the unpacked file."""
        return self.path / name if self.path.is_dir() else self.path

    def read(self, name: str) -> bytes:
        if self.path.is_dir():
            return read_file(self.path / name, _LARGEST, _FIX)
        with self._open() as archive:
            try:
                if archive.getinfo(name).file_size > _LARGEST:
                    raise PlgsError("too-large", f"{name} is too large", self.path, _FIX)
                return archive.read(name)
            except KeyError as error:
                raise PlgsError("file-missing", f"{name} is missing", self.path, _FIX) from error
            except (BadZipFile, OSError, ValueError, NotImplementedError, RuntimeError, EOFError) as error:
                raise PlgsError("file-damaged", f"{name} cannot be unpacked", self.path, _FIX) from error

    def _open(self) -> ZipFile:
        try:
            refuse_special(self.path)
            return ZipFile(self.path)
        except (BadZipFile, OSError, ValueError, NotImplementedError) as error:
            raise PlgsError("not-r3d", "this is not a .r3d file, or it is cut off", self.path, _FIX) from error


def _find(place: Path) -> Path | None:
    """Return the archive or the folder it was unpacked to: ``place``, or the only archive in it; None without one."""
    is_unpacked = (place / "metadata").is_file() and (place / "rgbd").is_dir()
    return place if is_unpacked else only_file(place, ".r3d")


def _read(place: Path, progress: Progress) -> Capture:
    path, exported = _find(place), _exr_folder(place)
    if path is None and exported is None:
        raise PlgsError("not-one-file", "there is no .r3d file, or more than one", place, "Name a .r3d file.")
    if path is None and exported:
        metadata = read_json_object(exported / _EXPORTED)
        found = list(_exr_shots(metadata, exported, progress))
    else:
        archive = _Archive(path or place)
        metadata = parse_json_object(archive.read("metadata"), archive.path)
        found = list(_shots(metadata, archive, archive.path, progress))
    poses = [shot.camera.camera_to_world for _, shot in found if isinstance(shot, Shot)]
    up = upright_rotation(poses)[2] if poses else np.zeros(3)
    # ARKit's y, unless the cameras disagree: some recordings start from their first pose.
    fps = metadata.get("fps")
    return Capture(found, "y" if up[1] > _CLEARLY_Y else None, fps=fps if isinstance(fps, int | float) else None)


def _shots(metadata: dict[str, Any], archive: _Archive, path: Path, progress: Progress) -> Iterator[tuple[str, Found]]:
    names = {*archive.names()}
    numbers = sorted(int(match[1]) for name in names if (match := re.fullmatch(r"rgbd/(\d+)\.jpg", name)))
    has_size = all(isinstance(metadata.get(key), int) and 0 < metadata[key] < 2**14 for key in ("dw", "dh"))
    size = (int(metadata["dw"]), int(metadata["dh"])) if has_size else None
    for number, camera in _cameras(metadata, numbers, path, progress):
        if camera is None:
            yield str(number), None
            continue
        depth, conf = f"rgbd/{number}.depth", f"rgbd/{number}.conf"
        read = partial(_read_depth, archive, depth, conf if conf in names else None, size, camera)
        level = path / conf if path.is_dir() and conf in names else None  # an archive is one file
        shown = DepthMap(archive.file(depth), read, confidence=level) if depth in names else None
        picture = None if path.is_dir() else partial(_read_colour, archive, f"rgbd/{number}.jpg")
        yield str(number), Shot(str(number), camera, archive.file(f"rgbd/{number}.jpg"), shown, picture)


def _cameras(
    metadata: dict[str, Any], numbers: list[int], path: Path, progress: Progress
) -> Iterator[tuple[int, Camera | None]]:
    """Yield the number and camera of each picture, None as the camera if its pose is not finite."""
    count = len(take_list(metadata, "poses", "metadata", path))
    poses = take_array(metadata, "poses", "metadata", path, (count, 7))
    if not numbers or numbers[-1] >= count:
        raise PlgsError("unequal-counts", f"there are {count} poses and {len(numbers)} pictures", path, _FIX)
    for number in watched(numbers, progress):
        if not np.isfinite(poses[number]).all():
            yield number, None
            continue
        qx, qy, qz, qw, *position = poses[number].tolist()
        yield number, _lens(metadata, number, path).at(from_opengl(quaternion_pose((qw, qx, qy, qz), position, path)))


def _exr_folder(place: Path) -> Path | None:
    """Return the folder with pictures and OpenEXR files: ``place`` itself, or its subfolder; None without one."""
    for folder in (place, place / "EXR_RGBD"):
        if (folder / _EXPORTED).is_file() and (folder / "rgb").is_dir() and (folder / "depth").is_dir():
            return folder
    return None


def _exr_shots(metadata: dict[str, Any], folder: Path, progress: Progress) -> Iterator[tuple[str, Found]]:
    path = folder / _EXPORTED
    found = files_by_stem(folder / "rgb", {".jpg", ".jpeg", ".png"}, _FIX)
    pictures = {int(stem): picture for stem, picture in found.items() if stem.isdecimal()}
    for number, camera in _cameras(metadata, sorted(pictures), path, progress):
        depth = folder / "depth" / f"{number}.exr"
        shown = DepthMap(depth, partial(_read_exr, depth)) if depth.is_file() else None
        fault, name = fault_of(pictures[number]), str(number)
        yield name, None if camera is None else fault or Shot(name, camera, pictures[number], shown)


def _read_exr(path: Path) -> NDArray[np.float32]:
    if not read_exr_header(path).is_whole:  # read first: the library takes memory for all that a header claims
        raise PlgsError("exr-part", "the OpenEXR file does not hold exactly one picture", path, _FIX)
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return only_depth(file.channels()["R"].pixels.astype(np.float32))
    except (RuntimeError, ValueError, OSError, KeyError) as error:
        what = "the OpenEXR file cannot be read, is cut off, or lacks the channel R"
        raise PlgsError("exr-unreadable", what, path, _FIX) from error
    except MemoryError as error:
        raise PlgsError("no-memory", "no memory is left for the OpenEXR file", path, "Close other programs.") from error


def _lens(metadata: dict[str, Any], number: int, path: Path) -> Camera:
    """Return a picture's camera at the origin. The file does not tell where pixels count from: corners are assumed."""
    width, height = (take_number(metadata, key, "metadata", path) for key in "wh")
    each, whose = metadata.get("perFrameIntrinsicCoeffs"), f"frame {number}"
    if isinstance(each, list) and len(each) > number:
        own = each[number][:4] if isinstance(each[number], list) else each[number]
        fx, fy, cx, cy = take_array({"coefficients": own}, "coefficients", whose, path, (4,)).tolist()
    else:
        fx, _, _, _, fy, _, cx, cy, _ = take_array(metadata, "K", "metadata", path, (9,)).tolist()  # by columns
    return pinhole(width, height, fx, fy, cx, cy, path=path, fix=_FIX, whose=whose)


def _read_colour(archive: _Archive, name: str) -> NDArray[np.uint8]:
    return decode_bytes(archive.read(name), archive.path, as_colour=True)


def _read_depth(
    archive: _Archive, name: str, confidence: str | None, size: Size | None, camera: Camera
) -> NDArray[np.float32]:
    """Read planar depth, float32 [H, W] metres, 0 = none. ``name`` and ``confidence`` are entries of the archive;
    ``size`` is the depth's, None if not given."""
    width, height = size or max(_DEPTH_SIZES)  # the largest bounds what is unpacked
    values = np.frombuffer(_unpacked(archive, name, 4, min(width * height, _MOST_DEPTHS)), "<f4")
    if size is None:  # that of a sensor, in the picture's orientation
        upright = camera.height > camera.width
        known = [each for each in _DEPTH_SIZES if each[0] * each[1] == len(values) and (each[1] > each[0]) is upright]
        if not known:
            raise PlgsError("unknown-size", f"{name} has a size that is not known", archive.path, _FIX)
        width, height = known[0]
    if width * height != len(values):
        raise PlgsError("other-size", f"{name} does not hold {width}x{height} numbers", archive.path, _FIX)
    depth = only_depth(values.reshape(height, width))
    if confidence is not None:
        level = np.frombuffer(_unpacked(archive, confidence, 1, depth.size), np.uint8)
        if len(level) == depth.size:
            depth = drop_untrusted(depth, level.reshape(depth.shape), archive.path)
    return depth


def _unpacked(archive: _Archive, name: str, step: int, most: int) -> bytes:
    """Unpack a file of the archive to a multiple of ``step`` bytes, at most ``most``. Raises PlgsError for damage."""
    data = archive.read(name)
    try:
        import liblzfse
    except ImportError as error:
        raise lacks_part("Record3D's depth needs the package pyliblzfse", archive.path, "record3d") from error
    try:
        unpacked = unpack_lzfse(data, most * step, liblzfse.decompress)
    except (liblzfse.error, ValueError, MemoryError) as error:
        raise PlgsError("file-damaged", f"{name} cannot be decompressed ({error})", archive.path, _FIX) from error
    if len(unpacked) % step:
        raise PlgsError("cut-off", f"{name} is cut off", archive.path, _FIX)
    return unpacked


def unpack_lzfse(data: bytes, most_bytes: int, decompress: Callable[[bytes], bytes]) -> bytes:
    """Unpack an LZFSE stream. Raises ValueError if it is cut off or larger than ``most_bytes``, and what ``decompress``
    raises. The library first takes the memory that the first block claims, then doubles it until all blocks fit."""
    if len(data) < _SHORTEST:
        raise ValueError("it is cut off")
    if int.from_bytes(data[4:8], "little") > most_bytes or data.count(_BLOCK) > 4 + most_bytes // _FULL_BLOCK:
        raise ValueError(f"it unpacks to more than {most_bytes} bytes")
    unpacked = decompress(data)
    if len(unpacked) > most_bytes:
        raise ValueError(f"it unpacks to more than {most_bytes} bytes")
    return unpacked


FORMAT = SceneFormat("record3d", lambda place: _find(place) is not None or _exr_folder(place) is not None, _read)
