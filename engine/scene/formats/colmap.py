"""A COLMAP reconstruction: a sparse model beside the folder ``images``.

World-to-camera poses, OpenCV axes, pixel centres at +0.5; the world is turned and scaled as the reconstruction left
it. Pictures of lenses that bend are undistorted on reading. A dense workspace has depth as well:
``stereo/depth_maps/<image>.geometric.bin`` (or ``.photometric.bin``), planar, in the reconstruction's lengths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...gates import read_plain
from ..camera import Camera
from ..colour import ColourReader
from ..frame import SceneError, Size
from ..image_header import read_image_header
from ..json_file import file_inside
from ..layout import listed, natural_order, same_shape, shown_size
from ..matrices import placed
from ..pixels import resize_nearest
from ..sparse_points import SparsePoints
from .capture import Capture, Shot
from .colmap_model import ColmapCamera, ColmapImage, ColmapModel, has_model, read_model
from .frame_names import frame_names
from .lens import UNDISTORTED, Distortion, UndistortedColour, UndistortedDepth
from .poses import inverse, quaternion_pose

LOOKS_FOR = "cameras and images, .bin or .txt, in sparse/0, sparse, model or colmap/sparse/0"
_MODELS = ("sparse/0", "sparse", "model", "colmap/sparse/0", ".")
_IMAGES = ("images", "image", "rgb", "color", "input", ".")
_SCALE = "COLMAP's lengths have no unit, and a lift takes them for metres: scale the model where that is far off"
_MOST_DEPTH = 1 << 30


def recognises(place: Path) -> bool:
    return any(has_model(place / name) for name in _MODELS)


def read(place: Path) -> Capture:
    """Open the registered images; only headers of images are read. Raises SceneError."""
    folder = next((place / name for name in _MODELS if has_model(place / name)), None)
    if folder is None:
        raise SceneError("there is no COLMAP model", place, f"Give {LOOKS_FOR}.")
    model = read_model(folder)
    images = sorted(model.images, key=lambda image: natural_order(image.name))
    if not images:
        raise SceneError("the model has no registered image", folder, "Let COLMAP register some.")
    names = frame_names([image.name for image in images])
    root = _find_images(place, images)
    shots = tuple(_shot(name, image, model, root, place) for name, image in zip(names, images, strict=True))
    warnings = [_SCALE]
    if any(isinstance(shot.read_colour, UndistortedColour) for shot in shots):
        warnings.append(UNDISTORTED)
    others = [each.name for each in sorted(folder.parent.glob("[0-9]*")) if each != folder and has_model(each)]
    if folder.name == "0" and others:
        warnings.append(f"only the model 0 is read: there are {listed(others)} as well")
    return Capture(shots, None, warnings=tuple(warnings), points=_points(model, names, images))


def _find_images(place: Path, images: list[ColmapImage]) -> Path:
    """The folder that image names count from: the first that has the first image. Raises SceneError."""
    first = images[0].name
    for name in _IMAGES:
        if file_inside(place / name, first, place).is_file():
            return place / name
    raise SceneError("the pictures are missing", place / "images" / first, "Put COLMAP's pictures into images.")


def _shot(name: str, image: ColmapImage, model: ColmapModel, root: Path, place: Path) -> Shot:
    path = file_inside(root, image.name, model.folder)
    if image.camera not in model.cameras:
        raise SceneError(
            f"image {name} has camera {image.camera}, which is not there", model.folder, "Export it again."
        )
    camera = model.cameras[image.camera]
    lens, distortion = _pinhole(camera, model.folder)
    size = read_image_header(path).size
    if not same_shape(size, (camera.width, camera.height)):
        shape = shown_size((camera.width, camera.height))
        raise SceneError(f"the picture is {shown_size(size)}, its camera {shape}", path, "Give COLMAP's own pictures.")
    lens = lens.resized(*size)
    pose = inverse(quaternion_pose(image.rotation, image.translation, model.folder))
    read_colour: Callable[[Size | None], NDArray[np.uint8]] = ColourReader(path)
    depth_path = _find_depth(place, image.name)
    read_depth: Callable[[Size | None], NDArray[np.float32]] | None = (
        DenseDepthReader(depth_path) if depth_path else None
    )
    if distortion.bends:
        read_colour = UndistortedColour(read_colour, lens, distortion, path)
        if read_depth is not None:
            read_depth = UndistortedDepth(read_depth, lens, distortion, path)
    return Shot(name, placed(lens, pose), path, read_colour, depth_path, read_depth, not distortion.bends)


def _pinhole(camera: ColmapCamera, folder: Path) -> tuple[Camera, Distortion]:
    """A camera at the origin with the lens's focal lengths, and its distortion. Raises SceneError."""
    model, values = camera.model, camera.parameters
    if model.startswith(("SIMPLE", "RADIAL")):
        (f, cx, cy), rest = values[:3], values[3:]
        fx = fy = f
    else:
        (fx, fy, cx, cy), rest = values[:4], values[4:]
    if fx <= 0.0 or fy <= 0.0 or not (0.0 <= cx <= camera.width and 0.0 <= cy <= camera.height):
        raise SceneError("a camera has intrinsics that no camera has", folder, "Let COLMAP refine or fix them.")
    lens = Camera(camera.width, camera.height, fx, fy, cx, cy, np.eye(4))
    if model in ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        return lens, Distortion("fisheye", (*rest, 0.0, 0.0, 0.0)[:4])
    if model in ("FOV", "THIN_PRISM_FISHEYE"):
        fix = "Run COLMAP's image_undistorter, and name the folder that it writes."
        raise SceneError(f"the camera model {model} is not known here", folder, fix)
    count = 8 if model == "FULL_OPENCV" else 4
    return lens, Distortion("brown", (*rest, *([0.0] * 4))[:count] if rest else ())


def _points(model: ColmapModel, names: list[str], images: list[ColmapImage]) -> SparsePoints | None:
    """The model's points, with those that each frame shows; None when there are none."""
    if not len(model.points):
        return None
    order = np.argsort(model.point_ids)
    ids = model.point_ids[order]
    seen_by = {}
    for name, image in zip(names, images, strict=True):
        wanted = np.unique(image.points)
        places = np.searchsorted(ids, wanted).clip(0, len(ids) - 1)
        seen_by[name] = order[places[ids[places] == wanted]]
    return SparsePoints(model.points.xyz, model.points.rgb, seen_by)


def _find_depth(place: Path, image: str) -> Path | None:
    """An image's depth map in a dense workspace."""
    folder = place / "stereo" / "depth_maps"
    found = (folder / f"{image}.{kind}.bin" for kind in ("geometric", "photometric"))
    return next((path for path in found if path.is_file()), None)


@dataclass(frozen=True)
class DenseDepthReader:
    """Reads a depth map of COLMAP's stereo: "width&height&channels&" and float32, row by row."""

    path: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W], 0 = none. Raises SceneError."""
        try:
            data = read_plain(self.path, _MOST_DEPTH)
        except OSError as error:
            fix = "Check that it exists."
            raise SceneError(f"the file cannot be read ({error.strerror})", self.path, fix) from error
        head = data[:64].split(b"&", 3)
        if len(head) < 4 or not all(part.isdigit() for part in head[:3]):
            raise SceneError("this is no depth map of COLMAP's", self.path, "Let COLMAP write it again.")
        width, height, channels = (int(part) for part in head[:3])
        start = sum(len(part) + 1 for part in head[:3])
        if channels != 1 or not width * height or len(data) != start + 4 * width * height:
            raise SceneError("the depth map is cut off", self.path, "Let COLMAP write it again.")
        depth = np.frombuffer(data, "<f4", offset=start).reshape(height, width)
        depth = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))
        return resize_nearest(depth, size) if size else depth
