"""Hypersim: a scene ``ai_VVV_NNN`` with its folders ``_detail`` and ``images``. Reading HDF5 needs the package h5py.

* ``_detail/cam_00/camera_keyframe_positions.hdf5`` (asset units) and ``..._orientations.hdf5`` (camera-to-world,
  OpenGL axes, z up); ``_detail/metadata_scene.csv`` says how many metres an asset unit has.
* ``images/scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5``: the distance to the camera's centre, in metres;
  NaN is none. It becomes planar depth.
* ``images/scene_cam_00_final_preview/frame.0000.tonemap.jpg``, or ``scene_cam_00_final_hdf5/frame.0000.color.hdf5``,
  linear, which is tone mapped as the project's own tool does it.
* ``metadata_camera_parameters.csv`` (of the project, for all scenes; in the scene's folder or one of the two above):
  the rays of each pixel, ``M_cam_from_uv``. More than half of the scenes have a tilted lens: they are straightened.

All cameras of a scene are frames of it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourReader
from ..frame import SceneError, Size
from ..image_header import read_image_header
from ..matrices import placed
from .capture import Capture, Shot
from .hdf5 import read_hdf5, shape_of_hdf5
from .hypersim_pixels import PlanarDepth, Projection, StraightColour, ToneMapped
from .poses import finite_pose, from_opengl

LOOKS_FOR = "_detail/metadata_scene.csv and images/scene_cam_00_geometry_hdf5"
_FIX = "Download the scene again."
_PARAMETERS = "metadata_camera_parameters.csv"
_USUAL = np.diag([0.5773502886169104, 0.4330127164626828, -1.0])
"""M_cam_from_uv of a lens that sees 60 degrees of 1024x768: f = 886.81."""
_GUESSED = (
    f"{_PARAMETERS} is not there, so the lens is taken for the usual one; more than half of the scenes have another: "
    "get it from Hypersim's repository (contrib/mikeroberts3000) and put it beside the scene"
)


@dataclass(frozen=True)
class _Picture:
    """One frame of a camera: its files."""

    camera: str
    number: int
    colour: Path
    depth: Path

    @property
    def name(self) -> str:
        return f"{self.camera}_{self.number:04d}"


def recognises(place: Path) -> bool:
    return (place / "_detail" / "metadata_scene.csv").is_file() and (place / "images").is_dir()


def read(place: Path) -> Capture:
    """Open the frames of all cameras. Raises SceneError."""
    metres = _metres_a_unit(place / "_detail" / "metadata_scene.csv")
    rays, warnings = _read_rays(place)
    shots, lost = [], []
    for camera in sorted(path for path in (place / "_detail").glob("cam_*") if path.is_dir()):
        positions = read_hdf5(camera / "camera_keyframe_positions.hdf5", 2)
        turns = read_hdf5(camera / "camera_keyframe_orientations.hdf5", 3)
        if positions.shape[1:] != (3,) or turns.shape != (len(positions), 3, 3):
            raise SceneError("positions and orientations do not belong together", camera, _FIX)
        for picture in _pictures(place / "images", camera.name):
            if picture.number >= len(positions):
                raise SceneError(f"frame {picture.number} has no pose", camera, _FIX)
            matrix = np.column_stack([turns[picture.number], positions[picture.number] * metres])
            pose = finite_pose(matrix.astype(np.float64), camera / "camera_keyframe_orientations.hdf5")
            if pose is None:
                lost.append(picture.name)
            else:
                shots.append(_shot(picture, from_opengl(pose), rays))
    return Capture(tuple(shots), "z", tuple(lost), tuple(warnings), up_is_known=True)


def _pictures(images: Path, camera: str) -> Iterator[_Picture]:
    """A camera's frames that have colour and depth, by number."""
    geometry = images / f"scene_{camera}_geometry_hdf5"
    for depth in sorted(geometry.glob("frame.*.depth_meters.hdf5")):
        match = re.fullmatch(r"frame\.(\d+)\.depth_meters\.hdf5", depth.name)
        if match is not None:
            preview = images / f"scene_{camera}_final_preview" / f"frame.{match[1]}.tonemap.jpg"
            colour = images / f"scene_{camera}_final_hdf5" / f"frame.{match[1]}.color.hdf5"
            yield _Picture(camera, int(match[1]), preview if preview.is_file() else colour, depth)


def _shot(picture: _Picture, pose: NDArray[np.float64], rays: NDArray[np.float64]) -> Shot:
    if picture.colour.suffix == ".jpg":
        size = read_image_header(picture.colour).size
        read_colour: ColourReader | ToneMapped = ColourReader(picture.colour)
    else:
        size = _hdf5_size(picture.colour, 3)
        read_colour = ToneMapped(picture.colour)
    projection = Projection(*size, tuple(rays.ravel().tolist()))
    lens = projection.pinhole()
    if not (np.isfinite([lens.fx, lens.fy, lens.cx, lens.cy]).all() and lens.fx > 0.0 and lens.fy > 0.0):
        raise SceneError("the camera's parameters are those of no camera", picture.colour, f"Correct {_PARAMETERS}.")
    return Shot(
        name=picture.name,
        camera=placed(lens, pose),
        colour_path=picture.colour,
        read_colour=StraightColour(read_colour, projection) if projection.is_tilted else read_colour,
        depth_path=picture.depth,
        read_depth=PlanarDepth(picture.depth, projection),
        file_shows_colour=picture.colour.suffix == ".jpg" and not projection.is_tilted,
    )


def _hdf5_size(path: Path, dimensions: int) -> Size:
    shape = shape_of_hdf5(path, dimensions)
    return shape[1], shape[0]


def _metres_a_unit(path: Path) -> float:
    for row in _read_table(path):
        if row.get("parameter_name") == "meters_per_asset_unit":
            try:
                metres = float(row.get("parameter_value") or "")
            except ValueError as error:
                raise SceneError("meters_per_asset_unit is no number", path, _FIX) from error
            if 0.0 < metres < 1e6:
                return metres
    raise SceneError("meters_per_asset_unit is missing", path, _FIX)


def _read_rays(place: Path) -> tuple[NDArray[np.float64], list[str]]:
    """M_cam_from_uv, float64 [3, 3], and warnings."""
    name = place.resolve().name
    folders = (place, place.resolve().parent, place.resolve().parent.parent)
    path = next((folder / _PARAMETERS for folder in folders if (folder / _PARAMETERS).is_file()), None)
    if path is None:
        return _USUAL, [_GUESSED]
    row = next((row for row in _read_table(path) if row.get("scene_name") == name), None)
    if row is None:
        fix = "Keep the folder's name as Hypersim has it, such as ai_001_001."
        raise SceneError(f"there are no camera parameters of a scene {name}", path, fix)
    try:
        values = [float(row[f"M_cam_from_uv_{i}{j}"] or "") for i in range(3) for j in range(3)]
    except (KeyError, ValueError) as error:
        raise SceneError(f"the camera parameters of {name} are not numbers", path, "Download it again.") from error
    rays = np.array(values).reshape(3, 3)
    if not np.isfinite(rays).all() or abs(np.linalg.det(rays)) < 1e-9:
        raise SceneError(f"the camera parameters of {name} are those of no camera", path, "Download it again.")
    return rays, []


def _read_table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                {key.strip(): value for key, value in row.items() if key and isinstance(value, str)}
                for row in csv.DictReader(file, skipinitialspace=True)
            ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise SceneError("this is no table", path, _FIX) from error
