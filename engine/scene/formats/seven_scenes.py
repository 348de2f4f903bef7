"""``frame-000000.{color,depth,pose}``: 7-Scenes, and tsdf-fusion's and 3DMatch's layout, which has intrinsics.

Frames lie in the folder or in its folders ``seq-01``, ... Poses are camera-to-world, 4x4, OpenCV axes, metres. Depth
is a 16-bit PNG in millimetres; 0 and 65535 are none. The world stands as the first camera did.

* With ``camera-intrinsics.txt`` (tsdf-fusion, 3DMatch) or ``camera-intrinsics.color.txt``: 3x3, integer pixel
  centres, for colour and depth alike.
* Without (7-Scenes): raw pictures of a Kinect. Poses and depth are the depth camera's, f 585; the colour camera, f
  525, stands 2.5 cm beside it. Depth is read from ``frame-000000.depth.proj.png`` if that exists: there it is
  registered to colour already. Else it is registered with a Kinect's calibration (LIRIS), as ACE does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.camera import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import natural_order
from ...posed.matrices import read_intrinsics, read_poses
from ..depth import png_depth, registered
from .capture import Capture, SceneFormat, Shot
from .poses import inverse

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


def _recognises(place: Path) -> bool:
    return _has_frames(place) and _find_intrinsics(place) is None


def _recognises_tsdf(place: Path) -> bool:
    return _has_frames(place) and _find_intrinsics(place) is not None


def _find_intrinsics(place: Path) -> Path | None:
    names = ("camera-intrinsics.txt", "camera-intrinsics.color.txt")
    found = (folder / name for folder in (place, place.parent) for name in names)
    return next((path for path in found if path.is_file()), None)


def _has_frames(place: Path) -> bool:
    return place.is_dir() and any(next(folder.glob("frame-*.pose.txt"), None) for folder in _folders(place))


def _folders(place: Path) -> list[Path]:
    return [place, *sorted(path for path in place.glob("seq-*") if path.is_dir())]


def _read(place: Path) -> Capture:
    """Open 7-Scenes; only headers of images are read. Raises PlgsError."""
    return _capture(place, None)


def _read_tsdf(place: Path) -> Capture:
    """Open frames with ``camera-intrinsics.txt``; only headers of images are read. Raises PlgsError."""
    intrinsics = _find_intrinsics(place)
    if intrinsics is None:
        fix = "Write the 3x3 matrix of colour and depth there."
        raise PlgsError("the intrinsics are missing", place / "camera-intrinsics.txt", fix)
    return _capture(place, intrinsics)


def _capture(place: Path, intrinsics: Path | None) -> Capture:
    kinds = ("frame-*.pose.txt", "frame-*.color.*")
    files = {path for folder in _folders(place) for kind in kinds for path in folder.glob(kind)}
    bases = {path.with_name(path.name.partition(".")[0]) for path in files}
    named = {
        base.name if base.parent == place else f"{base.parent.name}_{base.name}": base
        for base in sorted(bases, key=lambda base: natural_order(base.relative_to(place).as_posix()))
    }
    poses = read_poses({name: base.with_name(f"{base.name}.pose.txt") for name, base in named.items()})
    return Capture([(name, _shot(name, base, poses[name], intrinsics)) for name, base in named.items()], None)


def _shot(name: str, base: Path, pose: NDArray[np.float64] | None, intrinsics: Path | None) -> Shot | None:
    """The frame whose files begin with ``base``; None without a ``pose``. Raises PlgsError."""
    if pose is None:
        return None
    colours = [base.with_name(f"{base.name}.color.{suffix}") for suffix in ("png", "jpg", "jpeg")]
    colour = next((path for path in colours if path.is_file()), colours[0])
    size = read_image_header(colour).size
    depth, projected = base.with_name(f"{base.name}.depth.png"), base.with_name(f"{base.name}.depth.proj.png")
    if intrinsics is not None:
        lens = read_intrinsics(intrinsics, size)
        return Shot(name, lens.at(pose), colour, png_depth(depth, lens, none_from=_NONE))
    lens = _kinect(_COLOUR_F).resized(*size)
    if projected.is_file():
        return Shot(name, lens.at(pose), colour, png_depth(projected, lens, none_from=_NONE))
    beside = inverse(_DEPTH_TO_COLOUR)
    measured = png_depth(depth, lens, none_from=_NONE)
    shown = measured.through(lambda values: registered(values, _kinect(_DEPTH_F), lens.at(beside)))
    return Shot(name, lens.at(pose @ beside), colour, shown)


def _kinect(focal_length: float) -> Camera:
    """A Kinect's lens with its principal point at the integer pixel (320, 240)."""
    return Camera(640, 480, focal_length, focal_length, 320.5, 240.5, np.eye(4))


SEVEN_SCENES = SceneFormat("7scenes", _recognises, _read)
TSDF_FUSION = SceneFormat("tsdf-fusion", _recognises_tsdf, _read_tsdf)
