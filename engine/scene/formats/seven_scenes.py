"""``frame-000000.{color,depth,pose}``: 7-Scenes, and tsdf-fusion's and 3DMatch's layout, which has intrinsics.

Frames lie in the folder or in its folders ``seq-01``, ... Poses are camera-to-world, 4x4, OpenCV axes, metres. Depth
is a 16-bit PNG in millimetres; 0 and 65535 are none. The world stands as the first camera did.

* With ``camera-intrinsics.txt`` (tsdf-fusion, 3DMatch): 3x3, integer pixel centres, for colour and depth alike.
* Without (7-Scenes): raw pictures of a Kinect. Poses and depth are the depth camera's, f 585; the colour camera, f
  525, stands 2.5 cm beside it. Depth is registered to colour with a Kinect's calibration (LIRIS), as ACE does, or
  read from ``frame-000000.depth.proj.png`` where somebody has done it already.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..camera import Camera
from ..colour import ColourReader
from ..depth import DepthReader, check_depth_header
from ..frame import SceneError
from ..image_header import read_image_header
from ..layout import natural_order
from ..matrices import placed, read_intrinsics, read_pose
from .capture import Capture, Shot
from .poses import inverse
from .registration import RegisteredDepth

LOOKS_FOR = "frame-000000.pose.txt and .color.png, in the folder or in seq-01"
LOOKS_FOR_TSDF = f"{LOOKS_FOR}, with camera-intrinsics.txt"
_NONE = 65535
_DEPTH_TO_COLOUR = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""From points of a Kinect's depth camera to points of its colour camera, metres (LIRIS, INSA Lyon)."""
_DEPTH_F, _COLOUR_F = 585.0, 525.0


def recognises(place: Path) -> bool:
    return _has_frames(place) and _find_intrinsics(place) is None


def recognises_tsdf(place: Path) -> bool:
    return _has_frames(place) and _find_intrinsics(place) is not None


def read(place: Path) -> Capture:
    """Open 7-Scenes; only headers of images are read. Raises SceneError."""
    return _read(place, None)


def read_tsdf(place: Path) -> Capture:
    """Open frames with ``camera-intrinsics.txt``; only headers of images are read. Raises SceneError."""
    intrinsics = _find_intrinsics(place)
    if intrinsics is None:
        fix = "Write the 3x3 matrix of colour and depth there."
        raise SceneError("the intrinsics are missing", place / "camera-intrinsics.txt", fix)
    return _read(place, intrinsics)


def _find_intrinsics(place: Path) -> Path | None:
    found = (folder / "camera-intrinsics.txt" for folder in (place, place.parent))
    return next((path for path in found if path.is_file()), None)


def _has_frames(place: Path) -> bool:
    return place.is_dir() and any(next(folder.glob("frame-*.pose.txt"), None) for folder in _folders(place))


def _folders(place: Path) -> list[Path]:
    return [place, *sorted(path for path in place.glob("seq-*") if path.is_dir())]


def _read(place: Path, intrinsics: Path | None) -> Capture:
    paths = [path for folder in _folders(place) for path in folder.glob("frame-*.pose.txt")]
    paths.sort(key=lambda path: natural_order(path.relative_to(place).as_posix()))
    shots, lost = [], []
    for path in paths:
        stem = path.name.removesuffix(".pose.txt")
        name = stem if path.parent == place else f"{path.parent.name}_{stem}"
        shot = _shot(name, path, intrinsics)
        if shot is None:
            lost.append(name)
        else:
            shots.append(shot)
    return Capture(tuple(shots), None, tuple(lost))


def _shot(name: str, pose_path: Path, intrinsics: Path | None) -> Shot | None:
    """One frame; None when its pose holds inf. Raises SceneError."""
    pose = read_pose(pose_path)
    if pose is None:
        return None
    base = pose_path.with_name(pose_path.name.removesuffix(".pose.txt"))
    colours = [base.with_name(f"{base.name}.color.{suffix}") for suffix in ("png", "jpg", "jpeg")]
    colour = next((path for path in colours if path.is_file()), colours[0])
    size = read_image_header(colour).size
    depth, projected = base.with_name(f"{base.name}.depth.png"), base.with_name(f"{base.name}.depth.proj.png")
    if intrinsics is not None:
        camera = placed(read_intrinsics(intrinsics, size), pose)
        check_depth_header(depth, camera)
        return Shot(name, camera, colour, ColourReader(colour), depth, DepthReader(depth, none_from=_NONE))
    colour_lens, depth_lens = _kinect(_COLOUR_F).resized(*size), _kinect(_DEPTH_F)
    if projected.is_file():
        check_depth_header(projected, colour_lens)
        reader = DepthReader(projected, none_from=_NONE)
        return Shot(name, placed(colour_lens, pose), colour, ColourReader(colour), projected, reader)
    check_depth_header(depth, colour_lens)
    beside = inverse(_DEPTH_TO_COLOUR)
    registered = RegisteredDepth(DepthReader(depth, none_from=_NONE), depth_lens, placed(colour_lens, beside))
    return Shot(name, placed(colour_lens, pose @ beside), colour, ColourReader(colour), depth, registered)


def _kinect(focal_length: float) -> Camera:
    """A Kinect's lens with its principal point at the integer pixel (320, 240)."""
    return Camera(640, 480, focal_length, focal_length, 320.5, 240.5, np.eye(4))
