"""Hypersim: a scene ``ai_VVV_NNN`` with its folders ``_detail`` and ``images``. Reading HDF5 needs the package h5py.

* ``_detail/cam_00/camera_keyframe_positions.hdf5`` (asset units) and ``..._orientations.hdf5`` (camera-to-world,
  OpenGL axes, z up); ``_detail/metadata_scene.csv`` says how many metres an asset unit has.
* ``images/scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5``: the distance to the camera's centre, in metres;
  NaN is none. It becomes planar depth.
* ``images/scene_cam_00_final_preview/frame.0000.tonemap.jpg``, or ``scene_cam_00_final_hdf5/frame.0000.color.hdf5``,
  linear, which is tone mapped as the project's own tool does it.
* ``metadata_camera_parameters.csv`` (of the project, for all scenes; in the scene's folder or one of the two above):
  the rays of each pixel, ``M_cam_from_uv``. More than half of the scenes have a tilted lens: they are straightened.

All cameras of a scene are frames of it. Pixels are read in ``hypersim_pixels``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.image_header import read_image_header
from ..depth import DepthMap
from ..noted import Inferred, left_out
from ..pixels import decode
from .capture import Capture, SceneFormat, Shot, with_picture
from .hypersim_pixels import Projection, planar_depth, read_hdf5, size_of_hdf5, straightened, tone_mapped
from .poses import finite_pose, from_opengl

_FIX = "Download the scene again."
_PARAMETERS = "metadata_camera_parameters.csv"
_USUAL = np.diag([0.5773502886169104, 0.4330127164626828, -1.0])
"""M_cam_from_uv of a lens that sees 60 degrees of 1024x768: f = 886.81."""
_GUESSED = Inferred(
    "lens",
    f"{_PARAMETERS} is missing, so the usual lens is assumed",
    "more than half of the scenes have another: get the file from Hypersim's repository (contrib/mikeroberts3000) and "
    "put it beside the scene",
)


def _recognises(place: Path) -> bool:
    return (place / "_detail" / "metadata_scene.csv").is_file() and (place / "images").is_dir()


def _read(place: Path) -> Capture:
    """Open the frames of all cameras. Raises PlgsError."""
    metres = _metres_a_unit(place / "_detail" / "metadata_scene.csv")
    rays, inferred = _read_rays(place)
    found, blind = [], list[str]()
    for camera in sorted(path for path in (place / "_detail").glob("cam_*") if path.is_dir()):
        positions = read_hdf5(camera / "camera_keyframe_positions.hdf5", 2)
        turns = read_hdf5(camera / "camera_keyframe_orientations.hdf5", 3)
        if positions.shape[1:] != (3,) or turns.shape != (len(positions), 3, 3):
            raise PlgsError("positions and orientations do not belong together", camera, _FIX)
        pictures = list(_pictures(place / "images", camera.name))
        blind += _without_depth(place / "images", camera.name, {number for number, *_ in pictures})
        for number, colour, depth in pictures:
            if number >= len(positions):
                raise PlgsError(f"frame {number} has no pose", camera, _FIX)
            matrix = np.column_stack([turns[number], positions[number] * metres]).astype(np.float64)
            pose = finite_pose(matrix, camera / "camera_keyframe_orientations.hdf5")
            name = f"{camera.name}_{number:04d}"
            make = None if pose is None else partial(_shot, name, colour, depth, from_opengl(pose), rays)
            found.append((name, None if make is None else with_picture(colour, make)))
    return Capture(found, "z", up_is_known=True, left_out=left_out("depth", blind), inferred=inferred)


def _pictures(images: Path, camera: str) -> Iterator[tuple[int, Path, Path]]:
    """Numbers, pictures and depth files of a camera's frames that have both, by number."""
    geometry = images / f"scene_{camera}_geometry_hdf5"
    for depth in sorted(geometry.glob("frame.*.depth_meters.hdf5")):
        match = re.fullmatch(r"frame\.(\d+)\.depth_meters\.hdf5", depth.name)
        if match is not None:
            preview = images / f"scene_{camera}_final_preview" / f"frame.{match[1]}.tonemap.jpg"
            colour = images / f"scene_{camera}_final_hdf5" / f"frame.{match[1]}.color.hdf5"
            yield int(match[1]), preview if preview.is_file() else colour, depth


def _without_depth(images: Path, camera: str, with_depth: Collection[int]) -> list[str]:
    """The names of a camera's frames that have a preview, and no depth file."""
    previews = (images / f"scene_{camera}_final_preview").glob("frame.*.tonemap.jpg")
    numbers = (path.name.split(".")[1] for path in previews)
    found = sorted(int(number) for number in numbers if number.isdecimal())
    return [f"{camera}_{number:04d}" for number in found if number not in with_depth]


def _shot(name: str, colour: Path, depth: Path, pose: NDArray[np.float64], rays: NDArray[np.float64]) -> Shot:
    is_image = colour.suffix == ".jpg"
    width, height = read_image_header(colour).size if is_image else size_of_hdf5(colour)
    projection = Projection(width, height, tuple(rays.ravel().tolist()))
    lens = projection.pinhole()
    if not (np.isfinite([lens.fx, lens.fy, lens.cx, lens.cy]).all() and lens.fx > 0.0 and lens.fy > 0.0):
        raise PlgsError("no camera can have these camera parameters", colour, f"Correct {_PARAMETERS}.")
    read = partial(decode, colour, as_colour=True) if is_image else partial(tone_mapped, colour)
    if projection.is_tilted:
        read = partial(straightened, read, projection)
    depth_map = DepthMap(depth, partial(planar_depth, depth, projection))
    return Shot(name, lens.at(pose), colour, depth_map, None if is_image and not projection.is_tilted else read)


def _metres_a_unit(path: Path) -> float:
    for row in _read_table(path):
        if row.get("parameter_name") == "meters_per_asset_unit":
            try:
                metres = float(row.get("parameter_value") or "")
            except ValueError as error:
                raise PlgsError("meters_per_asset_unit is not a number", path, _FIX) from error
            if 0.0 < metres < 1e6:
                return metres
    raise PlgsError("meters_per_asset_unit is missing", path, _FIX)


def _read_rays(place: Path) -> tuple[NDArray[np.float64], tuple[Inferred, ...]]:
    """M_cam_from_uv, float64 [3, 3], and that it is assumed."""
    name = place.resolve().name
    folders = (place, place.resolve().parent, place.resolve().parent.parent)
    path = next((folder / _PARAMETERS for folder in folders if (folder / _PARAMETERS).is_file()), None)
    if path is None:
        return _USUAL, (_GUESSED,)
    row = next((row for row in _read_table(path) if row.get("scene_name") == name), None)
    if row is None:
        fix = "Keep the folder's name as Hypersim has it, such as ai_001_001."
        raise PlgsError(f"there are no camera parameters for a scene {name}", path, fix)
    try:
        values = [float(row[f"M_cam_from_uv_{i}{j}"] or "") for i in range(3) for j in range(3)]
    except (KeyError, ValueError) as error:
        raise PlgsError(f"the camera parameters of {name} are not numbers", path, "Download it again.") from error
    rays = np.array(values).reshape(3, 3)
    if not np.isfinite(rays).all() or abs(np.linalg.det(rays)) < 1e-9:
        raise PlgsError(f"no camera can have the camera parameters of {name}", path, "Download it again.")
    return rays, ()


def _read_table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                {key.strip(): value for key, value in row.items() if key and isinstance(value, str)}
                for row in csv.DictReader(file, skipinitialspace=True)
            ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise PlgsError("this is not a table", path, _FIX) from error


FORMAT = SceneFormat("hypersim", _recognises, _read)
