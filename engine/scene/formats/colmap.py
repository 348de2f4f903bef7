"""A COLMAP reconstruction: a sparse model beside the folder ``images``.

World-to-camera poses, OpenCV axes, pixel centres at +0.5; the world keeps the reconstruction's rotation and scale.
Pictures listed in ``test.txt`` beside the model are held out. A dense workspace, here or in ``dense/0`` or ``dense``,
has depth as well: ``stereo/depth_maps/<image>.geometric.bin`` (or ``.photometric.bin``), planar, in the
reconstruction's unit. If `python -m engine poses` made the model, depth beside the photos, in ``depth``, is read."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import LARGEST_TABLE, take_number
from ...posed.frames import Camera, inverse
from ...posed.layout import file_inside, listed, natural_order, read_file, read_text, shown_files
from ...posed.plain_folders import Split
from ..depth import DepthMap, fault_of, npy_depth, only_depth, png_depth
from ..files_of_frames import files_if_any
from ..frame import SparsePoints, left_out
from ..made import read_note
from .capture import Capture, Progress, SceneFormat, Shot, frame_names, watched, with_picture
from .colmap_model import EXPORT_AGAIN, MADE_BY, UNDISTORT, ColmapImage, ColmapModel, has_model, read_model
from .lens import Distortion, fitted, of_colmap, pinhole
from .photos import LET_COLMAP
from .poses import quaternion_pose

_LOOKS_FOR = "cameras and images, .bin or .txt, in sparse/0, sparse, model or colmap/sparse/0"
_MODELS = ("sparse/0", "sparse", "model", "colmap/sparse/0", ".")
_IMAGES = ("images", "image", "rgb", "color", "input", ".")
_DEPTH_MAPS = "stereo/depth_maps"
_DENSE = ("dense/0", "dense")
_PANORAMAS = (
    "COLMAP's image_undistorter cannot straighten panoramas: cut them into perspective pictures before COLMAP (its "
    "example panorama_sfm.py does), and name the folder with their model."
)
_STEREO = "Let COLMAP write it again, or delete it: the frame then has no depth."
_MOST_DEPTH = 1 << 30
_FARTHEST = 1e6  # in the reconstruction's unit; an interrupted stereo run leaves larger numbers in its file
_MOST_BROKEN = 0.5  # maximum fraction of such numbers in a depth map; COLMAP itself writes 0, or less, for no depth


def _find_model(place: Path) -> Path | None:
    return next((place / name for name in _MODELS if has_model(place / name)), None)


def _has_depth(place: Path) -> bool:
    """Whether ``place`` has depth maps, not only the empty folders that COLMAP's image_undistorter creates for them."""
    return any((place / _DEPTH_MAPS).rglob("*.bin"))


def _read(place: Path, progress: Progress) -> Capture:
    folder = _find_model(place)
    if folder is None:
        raise PlgsError("no-colmap-model", "the COLMAP model is missing", place, f"Give {_LOOKS_FOR}, or {LET_COLMAP}.")
    depths, warnings, path = dict[str, Path](), list[str](), folder / MADE_BY
    made_by = read_note(path, "Make the poses again.") or {}
    # Depth beside the photos is read if it gave the model its unit, metres.
    if made_by.get("scale") is not None:
        depths = files_if_any(place / "depth", {".png", ".npy"}, "Give one map per photo.")
    models = [each.name for each in sorted(shown_files(folder.parent, "[0-9]*")) if each != folder and has_model(each)]
    if folder.name == "0" and models:
        warnings.append(f"only the model 0 is read, but there are others: {listed(models)}")
    workspaces = [] if depths or _has_depth(place) else [place / name for name in _DENSE if _has_depth(place / name)]
    dense = ((workspace, own) for workspace in workspaces if (own := _find_model(workspace)) is not None)
    if workspace := next(dense, None):
        name = workspace[0].relative_to(place).as_posix()
        warnings.append(f"depth is in {name}, so its model and pictures are read: masks must be of these pictures")
        place, folder = workspace
    model = read_model(folder)
    images = sorted(model.images, key=lambda image: natural_order(image.name))
    if not images:
        what = "the model has no registered image"
        raise PlgsError("model-empty", what, folder, f"Move {folder.name} away, and {LET_COLMAP}.")
    names = frame_names([image.name for image in images])
    root = _find_images(place, images)
    paths = [file_inside(root, image.name, folder) for image in images]
    found = [
        (name, with_picture(path, partial(_shot, name, image, path, model=model, place=place, depths=depths)))
        for name, image, path in watched([*zip(names, images, paths, strict=True)], progress)
    ]
    folders, kinds = {path.parent for path in paths}, {path.suffix.lower() for path in paths}
    beside = {path for each in folders if each.is_dir() for path in shown_files(each) if path.is_file()}
    others = (path.relative_to(root) for path in beside.difference(paths) if path.suffix.lower() in kinds)
    unregistered = sorted((path.as_posix() for path in others), key=natural_order)
    lost = left_out("a pose (COLMAP did not register them)", unregistered)
    path = folder / "test.txt"  # of 3D Gaussian Splatting's programs
    lines = read_text(path, LARGEST_TABLE, "Write a picture's name on each line.") if path.is_file() else ""
    chosen = {line.strip() for line in lines.splitlines()}
    held_out = {name for name, image in zip(names, images, strict=True) if image.name in chosen}
    posed = [name for name, shot in found if isinstance(shot, Shot)]
    split = Split(*(tuple(name for name in posed if (name in held_out) is is_test) for is_test in (False, True)))
    own_split = split if split.train and split.test else None
    points = _points(model, names, images)
    has_rate = made_by.get("fps") is not None  # of the film that the pictures are from
    fps = take_number(made_by, "fps", "the file", folder / MADE_BY, least=0.001, most=1e5) if has_rate else None
    return Capture(found, None, tuple(warnings), points, own_split, left_out=lost, fps=fps, has_unit=bool(depths))


def _find_images(place: Path, images: list[ColmapImage]) -> Path:
    """Return the folder that image names are relative to: the first that contains the first image."""
    first = images[0].name
    for name in _IMAGES:
        if file_inside(place / name, first, place).is_file():
            return place / name
    what = "the pictures are missing"
    raise PlgsError("no-pictures", what, place / "images" / first, "Copy the pictures that COLMAP used to that folder.")


def _shot(
    name: str, image: ColmapImage, path: Path, *, model: ColmapModel, place: Path, depths: Mapping[str, Path]
) -> Shot:
    if image.camera not in model.cameras:
        what = f"image {name} has camera {image.camera}, which is missing"
        raise PlgsError("no-camera", what, model.folder, EXPORT_AGAIN)
    lens, distortion = _lens(model, image.camera)
    lens = fitted(lens, path, "Give COLMAP's own pictures.")
    pose = inverse(quaternion_pose(image.rotation, image.translation, model.folder))
    measured = depths.get(path.stem)
    if measured is None:
        dense = (place / _DEPTH_MAPS / f"{image.name}.{kind}.bin" for kind in ("geometric", "photometric"))
        file = next((each for each in dense if each.is_file()), None)
        depth = None if file is None else DepthMap(file, partial(_read_dense, file), fault=fault_of(file))
    else:
        depth = npy_depth(measured) if measured.suffix.lower() == ".npy" else png_depth(measured, lens)
    return Shot(name, lens.at(pose), path, depth, distortion=distortion)


def _lens(colmap: ColmapModel, number: int) -> tuple[Camera, Distortion]:
    """Return the lens ``number`` of the model as a camera at the origin, and its distortion."""
    camera, folder = colmap.cameras[number], colmap.folder
    model, values = camera.model, camera.parameters
    alone = 1 if model.startswith(("SIMPLE", "RADIAL")) else 2  # one focal length, or fx and fy
    (*focal, cx, cy), rest = values[: alone + 2], values[alone + 2 :]
    distortion = of_colmap(model, rest)
    if distortion is None:
        fix = _PANORAMAS if model == "EQUIRECTANGULAR" else UNDISTORT
        raise PlgsError("lens-model", f"the camera model {model} is not known here", folder, fix)
    fix = "Let COLMAP refine or fix them."
    return pinhole(camera.width, camera.height, focal[0], focal[-1], cx, cy, path=folder, fix=fix), distortion


def _points(model: ColmapModel, names: list[str], images: list[ColmapImage]) -> SparsePoints | None:
    """Return the model's points, and which of them each frame shows; None if there are none."""
    if not len(model.points):
        return None
    order = np.argsort(model.point_ids)
    ids = model.point_ids[order]
    seen_by = {}
    for name, image in zip(names, images, strict=True):
        wanted = np.unique(image.points)
        places = np.searchsorted(ids, wanted).clip(0, len(ids) - 1)  # an id may follow the last
        seen_by[name] = order[places[ids[places] == wanted]]
    return SparsePoints(model.points.xyz, model.points.rgb, seen_by)


def _read_dense(path: Path) -> NDArray[np.float32]:
    """Read a depth map [H, W] of COLMAP's stereo: the text "width&height&channels&", then float32 row by row."""
    data = read_file(path, _MOST_DEPTH)
    head = data[:64].split(b"&", 3)
    if len(head) < 4 or not all(part.isdigit() for part in head[:3]):
        raise PlgsError("not-depth-map", "this is not one of COLMAP's depth maps", path, _STEREO)
    width, height, channels = (int(part) for part in head[:3])
    start = sum(len(part) + 1 for part in head[:3])
    if channels != 1 or not width * height or len(data) != start + 4 * width * height:
        raise PlgsError("depth-cut-off", "the depth map is cut off", path, _STEREO)
    values = np.frombuffer(data, "<f4", offset=start).reshape(height, width)
    is_broken = ~(np.abs(values) < _FARTHEST)  # also where it is NaN
    if is_broken.mean() > _MOST_BROKEN:
        raise PlgsError("depth-broken", f"{is_broken.mean():.0%} of the depth map's values are no depth", path, _STEREO)
    return np.where(is_broken, np.float32(0.0), only_depth(values))


FORMAT = SceneFormat("colmap", lambda place: _find_model(place) is not None, _read)
