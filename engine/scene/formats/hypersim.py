"""Hypersim: a scene ``ai_VVV_NNN`` with its folders ``_detail`` and ``images``. Reading HDF5 needs the package h5py.

* ``_detail/cam_00/camera_keyframe_positions.hdf5`` (asset units) and ``..._orientations.hdf5`` (camera-to-world,
  OpenGL axes, z up); ``_detail/metadata_scene.csv`` says how many metres an asset unit has.
* ``images/scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5``: metres to the camera's centre; NaN is none.
* ``images/scene_cam_00_final_preview/frame.0000.tonemap.jpg``, or ``scene_cam_00_final_hdf5/frame.0000.color.hdf5``,
  linear, which is tone mapped as the project's own tool does it.
* ``metadata_camera_parameters.csv`` (of the project, for all scenes; in the scene's folder or one of the two above):
  the rays of each pixel, ``M_cam_from_uv``. More than half of the scenes have a tilted lens: they are straightened."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError, lacks_part
from ...job.progress import part_of
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import shown_files
from ..depth import DepthMap
from ..frame import Inferred, left_out
from ..pixels import decode
from .capture import Capture, Progress, SceneFormat, Shot, watched, with_picture
from .poses import finite_pose, from_opengl

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_STRAIGHT = 1e-6
_LARGEST = 2**27  # the largest number of values in one array: a picture of 8192x5461 in colour
_PIXELS_FIX = "Download this file again."
_BRIGHT, _BRIGHT_SHARE, _GAMMA = 0.8, 90.0, 1.0 / 2.2  # the 90th percentile becomes 0.8, after a gamma


@dataclass(frozen=True)
class Projection:
    """The rays of the pixels of a ``width`` x ``height`` picture. ``rays`` is M_cam_from_uv as nine numbers, row by
    row, which takes (u, v, 1), with u to the right and v up in -1..1, to a ray in OpenGL axes."""

    width: int
    height: int
    rays: tuple[float, ...]

    @property
    def is_tilted(self) -> bool:
        """Whether the image plane is tilted against the viewing direction, so that no pinhole camera has these rays."""
        ray = self.ray_of_pixel()
        return bool(np.abs(np.array([ray[0, 1], ray[1, 0], *(ray[2, :2])]) * self.width).max() > _STRAIGHT * 1e3)

    def ray_of_pixel(self) -> NDArray[np.float64]:
        """Matrix, float64 [3, 3], from (x, y, 1), centres at +0.5, to a ray in OpenCV axes; z is 1 in the middle."""
        to_uv = np.array([[2.0 / self.width, 0.0, -1.0], [0.0, -2.0 / self.height, 1.0], [0.0, 0.0, 1.0]])
        matrix = _TO_OPENCV @ np.array(self.rays).reshape(3, 3) @ to_uv
        return np.asarray(matrix / (matrix[2] @ [self.width / 2.0, self.height / 2.0, 1.0]))

    def pinhole(self) -> Camera:
        """A camera at the origin whose rays agree in the middle, and everywhere if the lens is not tilted."""
        ray = self.ray_of_pixel()
        middle = ray @ [self.width / 2.0, self.height / 2.0, 1.0]
        fx, fy = 1.0 / ray[0, 0], 1.0 / ray[1, 1]
        cx, cy = self.width / 2.0 - fx * middle[0], self.height / 2.0 - fy * middle[1]
        return Camera(self.width, self.height, float(fx), float(fy), float(cx), float(cy), np.eye(4))


@lru_cache(maxsize=4)
def _source_pixels(projection: Projection) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where the tilted picture shows each pixel of the pinhole's: x, y float32 [H, W], pixel centres at integers."""
    warp = np.linalg.inv(projection.ray_of_pixel()) @ np.linalg.inv(projection.pinhole().K)
    x, y = np.meshgrid(np.arange(projection.width) + 0.5, np.arange(projection.height) + 0.5)
    source = np.stack([x, y, np.ones_like(x)], axis=-1) @ warp.T
    # Rays behind the tilted plane do not belong to its pixels.
    scale = np.where(source[..., 2] > 1e-9, source[..., 2], np.nan)
    u, v = source[..., 0] / scale - 0.5, source[..., 1] / scale - 0.5  # in cv2 centres are integers
    return np.nan_to_num(u, nan=-1e6).astype(np.float32), np.nan_to_num(v, nan=-1e6).astype(np.float32)


def _straighten(pixels: NDArray[Any], projection: Projection, smooth: bool) -> NDArray[Any]:
    """Rectify a tilted picture [H, W, ...] to a pinhole camera's; black beyond its edges. ``smooth`` interpolates."""
    import cv2

    return cv2.remap(pixels, *_source_pixels(projection), cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)


def planar_depth(path: Path, projection: Projection) -> NDArray[np.float32]:
    """Read planar depth, float32 [H, W] metres, 0 = none, from a file of distances to the camera's centre. Raises
    PlgsError if it is bad or of another size than ``projection``."""
    distance = read_hdf5(path, 2).astype(np.float64)
    if distance.shape != (projection.height, projection.width):
        raise PlgsError("other-size", "depth and colour differ in size", path, "Download the scene again.")
    x, y = np.meshgrid(np.arange(projection.width) + 0.5, np.arange(projection.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ projection.ray_of_pixel().T
    depth = distance * rays[..., 2] / np.linalg.norm(rays, axis=-1)
    depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)
    return _straighten(depth, projection, smooth=False) if projection.is_tilted else depth


def tone_mapped(path: Path) -> NDArray[np.uint8]:
    """Read a linear picture and tone map it to uint8 [H, W, 3] RGB. Raises PlgsError if it is no colour picture."""
    linear = np.nan_to_num(read_hdf5(path, 3).astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if linear.shape[2] != 3:
        raise PlgsError("not-colour", "the picture does not have three channels", path, "Download it again.")
    bright = float(np.percentile(linear @ np.array([0.3, 0.59, 0.11], np.float32), _BRIGHT_SHARE))  # CCIR 601
    scale = _BRIGHT ** (1.0 / _GAMMA) / bright if bright > 1e-4 else 0.0  # a black picture stays black
    mapped = np.clip(np.maximum(scale * linear, 0.0) ** _GAMMA, 0.0, 1.0)
    return np.round(mapped * 255.0).astype(np.uint8)


def read_hdf5(path: Path, dimensions: int) -> NDArray[Any]:
    """Read the numbers in the array called "dataset", which must have this many ``dimensions``. Raises PlgsError if it
    is missing or damaged."""
    with _dataset(path, dimensions) as dataset:
        values: NDArray[Any] = dataset[()]
    return values


@contextmanager
def _dataset(path: Path, dimensions: int) -> Iterator[Any]:
    try:
        import h5py
    except ImportError as error:
        raise lacks_part("HDF5 files need the package h5py", path, "hypersim") from error
    if not path.is_file():
        raise PlgsError("file-missing", "the file is missing", path, _PIXELS_FIX)
    try:
        with h5py.File(path, "r") as file:  # is_file above: no FIFO
            dataset = file.get("dataset")
            if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
                raise PlgsError("no-array", 'there is no array of numbers called "dataset"', path, _PIXELS_FIX)
            if dataset.ndim != dimensions or not 0 < np.prod(dataset.shape, dtype=np.float64) <= _LARGEST:
                raise PlgsError("shape", f"the array has the shape {dataset.shape}", path, _PIXELS_FIX)
            yield dataset
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise PlgsError("file-damaged", "the file cannot be read, or is cut off", path, _PIXELS_FIX) from error


_FIX = "Download the scene again."
_PARAMETERS = "metadata_camera_parameters.csv"
_USUAL = np.diag([0.5773502886169104, 0.4330127164626828, -1.0])  # M_cam_from_uv of 60 degrees at 1024x768: f = 886.81
_GUESSED = Inferred(
    "lens",
    f"{_PARAMETERS} is missing, so the usual lens is assumed",
    "more than half of the scenes have another: get the file from Hypersim's repository (contrib/mikeroberts3000) and "
    "put it beside the scene",
)


def _read(place: Path, progress: Progress) -> Capture:
    metres = _metres_a_unit(place / "_detail" / "metadata_scene.csv")
    rays, inferred = _read_rays(place)
    found, blind = [], list[str]()
    cameras = sorted(path for path in shown_files(place / "_detail", "cam_*") if path.is_dir())
    for row, camera in enumerate(cameras):
        positions = read_hdf5(camera / "camera_keyframe_positions.hdf5", 2)
        turns = read_hdf5(camera / "camera_keyframe_orientations.hdf5", 3)
        if positions.shape[1:] != (3,) or turns.shape != (len(positions), 3, 3):
            raise PlgsError("poses-unpaired", "the positions and orientations of the camera do not match", camera, _FIX)
        pictures = list(_pictures(place / "images", camera.name))
        previews = shown_files(place / "images" / f"scene_{camera.name}_final_preview", "frame.*.tonemap.jpg")
        shown = {int(digits) for path in previews if (digits := path.name.split(".")[1]).isdecimal()}
        blind += [f"{camera.name}_{number:04d}" for number in sorted(shown - {number for number, *_ in pictures})]
        own = part_of(progress, row / len(cameras), (row + 1) / len(cameras), len(cameras) * len(pictures))
        for number, colour, depth in watched(pictures, own):
            if number >= len(positions):
                raise PlgsError("no-pose", f"frame {number} has no pose", camera, _FIX)
            matrix = np.column_stack([turns[number], positions[number] * metres]).astype(np.float64)
            pose = finite_pose(matrix, camera / "camera_keyframe_orientations.hdf5")
            name = f"{camera.name}_{number:04d}"
            make = None if pose is None else partial(_shot, name, colour, depth, from_opengl(pose), rays)
            found.append((name, with_picture(colour, make)))
    return Capture(found, "z", up_is_known=True, left_out=left_out("depth", blind), inferred=inferred)


def _pictures(images: Path, camera: str) -> Iterator[tuple[int, Path, Path]]:
    """Yield the number, picture and depth file of each of a camera's frames that has both, in order of number."""
    geometry = images / f"scene_{camera}_geometry_hdf5"
    for depth in sorted(shown_files(geometry, "frame.*.depth_meters.hdf5")):
        match = re.fullmatch(r"frame\.(\d+)\.depth_meters\.hdf5", depth.name)
        if match is not None:
            preview = images / f"scene_{camera}_final_preview" / f"frame.{match[1]}.tonemap.jpg"
            colour = images / f"scene_{camera}_final_hdf5" / f"frame.{match[1]}.color.hdf5"
            yield int(match[1]), preview if preview.is_file() else colour, depth


def _shot(name: str, colour: Path, depth: Path, pose: NDArray[np.float64], rays: NDArray[np.float64]) -> Shot:
    is_image = colour.suffix == ".jpg"
    if is_image:
        width, height = read_image_header(colour).size
    else:
        with _dataset(colour, 3) as dataset:
            height, width, _ = dataset.shape
    projection = Projection(width, height, tuple(rays.ravel().tolist()))
    lens = projection.pinhole()
    if not (np.isfinite([lens.fx, lens.fy, lens.cx, lens.cy]).all() and lens.fx > 0.0 and lens.fy > 0.0):
        raise PlgsError("bad-camera", "the camera parameters are impossible", colour, f"Correct {_PARAMETERS}.")
    stored = partial(decode, colour, as_colour=True) if is_image else partial(tone_mapped, colour)
    read = (lambda: _straighten(stored(), projection, smooth=True)) if projection.is_tilted else stored
    depth_map = DepthMap(depth, partial(planar_depth, depth, projection))
    return Shot(name, lens.at(pose), colour, depth_map, None if is_image and not projection.is_tilted else read)


def _metres_a_unit(path: Path) -> float:
    for row in _read_table(path):
        if row.get("parameter_name") == "meters_per_asset_unit":
            try:
                metres = float(row.get("parameter_value") or "")
            except ValueError as error:
                raise PlgsError("bad-unit", "meters_per_asset_unit is not a number", path, _FIX) from error
            if 0.0 < metres < 1e6:
                return metres
    raise PlgsError("no-unit", "meters_per_asset_unit is missing", path, _FIX)


def _read_rays(place: Path) -> tuple[NDArray[np.float64], tuple[Inferred, ...]]:
    """Return M_cam_from_uv, float64 [3, 3], and a note if it is assumed."""
    name, folders = place.resolve().name, (place, place.resolve().parent, place.resolve().parent.parent)
    path = next((folder / _PARAMETERS for folder in folders if (folder / _PARAMETERS).is_file()), None)
    if path is None:
        return _USUAL, (_GUESSED,)
    row = next((row for row in _read_table(path) if row.get("scene_name") == name), None)
    if row is None:
        fix = "Keep the folder's name as Hypersim has it, such as ai_001_001."
        raise PlgsError("no-camera", f"there are no camera parameters for a scene {name}", path, fix)
    try:
        values = [float(row[f"M_cam_from_uv_{i}{j}"] or "") for i in range(3) for j in range(3)]
    except (KeyError, ValueError) as error:
        what = f"the camera parameters of {name} are not numbers"
        raise PlgsError("bad-camera", what, path, "Download it again.") from error
    rays = np.array(values).reshape(3, 3)
    if not np.isfinite(rays).all() or abs(np.linalg.det(rays)) < 1e-9:
        raise PlgsError("bad-camera", f"the camera parameters of {name} are impossible", path, "Download it again.")
    return rays, ()


def _read_table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                {key.strip(): value for key, value in row.items() if key and isinstance(value, str)}
                for row in csv.DictReader(file, skipinitialspace=True)
            ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise PlgsError("not-table", "this is not a CSV table", path, _FIX) from error


FORMAT = SceneFormat(
    "hypersim",
    lambda place: (place / "_detail" / "metadata_scene.csv").is_file() and (place / "images").is_dir(),
    _read,
)
