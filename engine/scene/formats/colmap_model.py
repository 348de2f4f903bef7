"""COLMAP's sparse model, text or binary: cameras, images and points3D, as described in COLMAP's documentation."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.layout import check_count, read_file, read_text
from ..frame import SparsePoints

_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4),
    ("EUCM", 6), ("EQUIRECTANGULAR", 2),
)  # fmt: skip
"""Each model's name and number of parameters. Its index is its number in binary files."""
MADE_BY = "made_by.json"  # says in a model of `python -m engine poses` whether measured depth gave its scale
_SUFFIXES = ("bin", "txt")
_MOST_BYTES = 1 << 31
_MOST_POINTS = 4_000_000  # in a model, which take seven seconds; models of rooms have several hundred thousand
_MOST_LINES = 1_000_000  # maximum number of lines in a text file, which take some seconds
_LINE_IN_MEMORY = 500  # bytes for a line of text and the numbers parsed from it
_POINT_BYTES = 51  # minimum bytes per point in a binary file
_MOST_POINT_BYTES = _MOST_TEXT = 1 << 29
_POINTS_2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])  # point is -1 for features without one
EXPORT_AGAIN = "Let COLMAP write the model again, for example with colmap model_converter."
UNDISTORT = (
    "Run COLMAP's image_undistorter, and name the folder that it writes: colmap image_undistorter --image_path images "
    "--input_path sparse/0 --output_path dense."
)


@dataclass(frozen=True)
class ColmapCamera:
    """A lens: the name of COLMAP's ``model`` and its parameters, in pixels, with pixel centres at +0.5."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered picture: quaternion w x y z and translation, world-to-camera, and the ids of its points."""

    name: str
    camera: int
    rotation: tuple[float, ...]
    translation: tuple[float, ...]
    points: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model: cameras by id, images, and points. ``point_ids`` int64 [N] belong to the rows of ``points``."""

    folder: Path
    cameras: Mapping[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    point_ids: NDArray[np.int64]
    points: SparsePoints


def has_model(folder: Path) -> bool:
    """Whether a folder holds a model, as text or binary."""
    return any(all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images")) for suffix in _SUFFIXES)


def read_model(folder: Path) -> ColmapModel:
    """Read the model in ``folder``, the binary one if there are two. Raises PlgsError if it is damaged."""
    if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file():
        cameras, images = _binary_cameras(folder / "cameras.bin"), _binary_images(folder / "images.bin")
    else:
        cameras, images = _text_cameras(folder / "cameras.txt"), _text_images(folder / "images.txt")
    if (folder / "points3D.bin").is_file():
        point_ids, points = _binary_points(folder / "points3D.bin")
    elif (folder / "points3D.txt").is_file():
        point_ids, points = _text_points(folder / "points3D.txt")
    else:
        point_ids, points = _as_points([], [], [])
    return ColmapModel(folder, cameras, images, point_ids, points)


class _Bytes:
    """A binary file read from front to back. Methods raise PlgsError if it is shorter than it claims."""

    def __init__(self, path: Path, most_bytes: int = _MOST_BYTES) -> None:
        self.path, self.position, self.data = path, 0, read_file(path, most_bytes)

    def take(self, layout: str) -> tuple[float, ...]:
        """Read the next values; ``layout`` is a format of ``struct``."""
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout)))

    def count(self, things: str, least_bytes: int, most: int = _MOST_BYTES) -> int:
        """Read how many ``things`` follow. Raises PlgsError if the file is too short, at ``least_bytes`` for each."""
        count = int(self.take("<Q")[0])
        room = (len(self.data) - self.position) // least_bytes
        check_count(count, things, self.path, EXPORT_AGAIN, most=most, room=room, made=least_bytes)
        return count

    def text(self) -> str:
        """Read text up to the next zero byte."""
        end = self.data.find(b"\0", self.position)
        start = self.skip(end + 1 - self.position if end >= 0 else len(self.data) + 1)  # without a zero, skip raises
        return self.data[start:end].decode("utf-8", "replace")

    def array(self, fields: np.dtype[np.void], count: int) -> NDArray[np.void]:
        return np.frombuffer(self.data, fields, count, self.skip(count * fields.itemsize))

    def skip(self, size: int) -> int:
        """Skip ``size`` bytes and return where they begin."""
        if self.position + size > len(self.data):
            raise PlgsError("cut-off", "the file is cut off", self.path, EXPORT_AGAIN)
        self.position += size
        return self.position - size


def _binary_cameras(path: Path) -> dict[int, ColmapCamera]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count("cameras", 40)):  # the four numbers below, and two parameters at least
        camera, model, width, height = (int(value) for value in file.take("<IiQQ"))
        if not 0 <= model < len(_MODELS):
            what = f"camera {camera} has the model number {model}, which is not known"
            raise PlgsError("lens-model", what, path, UNDISTORT)
        name, count = _MODELS[model]
        cameras[camera] = _checked_camera(ColmapCamera(name, width, height, file.take(f"<{count}d")), camera, path)
    return cameras


def _binary_images(path: Path) -> tuple[ColmapImage, ...]:
    file, images = _Bytes(path), []
    for _ in range(file.count("images", 73)):  # the numbers below, the zero after a name, and a count
        _, w, x, y, z, *translation, camera = file.take("<I7dI")
        name = file.text()
        points = file.array(_POINTS_2D, file.count("points of an image", _POINTS_2D.itemsize))["point"]
        images.append(ColmapImage(name, int(camera), (w, x, y, z), tuple(translation), points[points >= 0]))
    return tuple(images)


def _binary_points(path: Path) -> tuple[NDArray[np.int64], SparsePoints]:
    file = _Bytes(path, _MOST_POINT_BYTES)
    count = file.count("points", _POINT_BYTES, _MOST_POINTS)
    ids, xyz, rgb = np.empty(count, np.int64), np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for row in range(count):
        ids[row], *xyz[row], red, green, blue, _, track = file.take("<q3d3BdQ")
        rgb[row] = red, green, blue
        file.skip(8 * int(track))  # pairs of an image and a feature, int32 each
    return ids, SparsePoints(xyz, rgb)


def _as_points(
    ids: Sequence[int], xyz: Sequence[Sequence[float]], rgb: Sequence[Sequence[float]]
) -> tuple[NDArray[np.int64], SparsePoints]:
    places, colours = np.array(xyz, np.float64).reshape(-1, 3), np.array(rgb).reshape(-1, 3).astype(np.uint8)
    return np.array(ids, np.int64), SparsePoints(places, colours)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not comments, with their numbers. Raises PlgsError for a file that is no text."""
    text = read_text(path, _MOST_TEXT, EXPORT_AGAIN)
    check_count(text.count("\n"), "lines", path, EXPORT_AGAIN, most=_MOST_LINES, room=len(text), made=_LINE_IN_MEMORY)
    return ((number, line) for number, line in enumerate(text.split("\n"), start=1) if not line.startswith("#"))


def _broken(path: Path, number: int) -> PlgsError:
    return PlgsError("bad-line", f"line {number} is not as COLMAP writes it", path, EXPORT_AGAIN)


def _text_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    counts = dict(_MODELS)
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            camera, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            parameters = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError) as error:
            raise _broken(path, number) from error
        if counts.get(model) != len(parameters):
            what = f"camera {camera} has the model {model[:40]} with {len(parameters)} numbers, which is not known"
            raise PlgsError("lens-model", what, path, EXPORT_AGAIN if model in counts else UNDISTORT)
        cameras[camera] = _checked_camera(ColmapCamera(model, width, height, parameters), camera, path)
    return cameras


def _checked_camera(camera: ColmapCamera, number: int, path: Path) -> ColmapCamera:
    if not (0 < camera.width < 2**16 and 0 < camera.height < 2**16 and np.isfinite(camera.parameters).all()):
        raise PlgsError("bad-camera", f"camera {number} has an impossible size or parameter", path, EXPORT_AGAIN)
    return camera


def _text_images(path: Path) -> tuple[ColmapImage, ...]:
    """Read the images: two lines for each, the second with its points in the picture, which may be empty."""
    lines, images = _lines(path), []
    for number, line in lines:
        words = line.split(maxsplit=9)  # the last is the name, which may contain spaces
        if not words:
            continue
        try:
            w, x, y, z, *translation = (float(word) for word in words[1:8])
            camera, name = int(words[8]), words[9].strip()
            points = np.array(next(lines, (0, ""))[1].split()[2::3], np.int64)  # x y id, x y id, ...
        except (ValueError, IndexError, OverflowError) as error:
            raise _broken(path, number) from error
        images.append(ColmapImage(name, camera, (w, x, y, z), tuple(translation), points[points >= 0]))
    return tuple(images)


def _text_points(path: Path) -> tuple[NDArray[np.int64], SparsePoints]:
    ids, xyz, rgb = [], [], []
    for number, line in _lines(path):
        words = line.split(maxsplit=7)  # error and track stay one word: lines are long
        if not words:
            continue
        try:
            x, y, z = (float(word) for word in words[1:4])
            red, green, blue = (float(int(word) & 255) for word in words[4:7])
            ids.append(int(np.int64(int(words[0]))))  # np.int64 raises OverflowError beyond 64 bits
        except (ValueError, OverflowError) as error:
            raise _broken(path, number) from error
        xyz.append((x, y, z))
        rgb.append((red, green, blue))
    return _as_points(ids, xyz, rgb)
