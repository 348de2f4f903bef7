"""``frame-000000.{color,depth,pose}``: 7-Scenes, BundleFusion, 12-Scenes and 3DMatch.

Frames lie in the folder or in its folders ``seq-01``, ... or ``data``. Poses are camera-to-world, 4x4, OpenCV axes,
metres. Depth is a 16-bit PNG in millimetres; 0 and 65535 mean none. The world's axes are the first camera's.

The lens is there or in the folder above, with integer pixel centres:

* ``camera-intrinsics.txt``, 3x3, for colour and depth alike; or ``colorIntrinsics.txt`` and ``depthIntrinsics.txt``
  (Intrinsic3D).
* ``info.txt`` (BundleFusion, 12-Scenes): ``m_calibrationColorIntrinsic`` and ``m_calibrationDepthIntrinsic``, 4x4, for
  pictures of the sizes that it says, and ``m_depthShift`` steps of depth per metre.
* Without (7-Scenes): raw pictures of a Kinect. Poses and depth are the depth camera's, f 585; the colour camera, f
  525, is 2.5 cm beside it. Depth is read from ``frame-000000.depth.proj.png`` if that exists: there it is
  registered to colour already. Else it is registered with a Kinect's calibration (LIRIS), as ACE does."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...job.progress import part_of
from ...posed.frames import Camera, inverse
from ...posed.image_header import read_image_header
from ...posed.layout import natural_order, read_text, shown_files
from ...posed.matrices import as_lens, read_intrinsics, read_poses
from ..depth import between_cameras, fitting_alignment, png_depth, registered, seen_by_colour
from ..frame import Inferred
from .capture import Capture, Found, Progress, SceneFormat, Shot, watched, with_picture
from .lens import assumed, fitted

_MOST_INFO = 1 << 16
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
_OWN_LENS = "camera-intrinsics.txt"
_INFO_FIX = "Copy the recorder's file again, or correct it."

_Reader = Callable[[str, Path, NDArray[np.float64], Path], Shot]
"""Makes the shot of a name, the files that begin with a path, a pose, and a colour picture."""


def _find(place: Path, *names: str) -> Path | None:
    found = (folder / name for folder in (place, place.parent) for name in names)
    return next((path for path in found if path.is_file()), None)


def _folders(place: Path) -> list[Path]:
    return [place, *sorted(path for path in (*shown_files(place, "seq-*"), place / "data") if path.is_dir())]


def _read(place: Path, progress: Progress) -> Capture:
    own = _find(place, _OWN_LENS, "colorIntrinsics.txt")
    if own is not None:
        return _capture(place, progress, partial(_own_lens_shot, (own, _find(place, "depthIntrinsics.txt") or own)))
    path = _find(place, "info.txt", "_info.txt")  # ScanNet's own reader writes the second
    # Unrelated texts may have the same name.
    if path is None or b"m_calibration" not in path.open("rb").read(_MOST_INFO):
        inferred = (assumed("a Kinect's", _kinect(_COLOUR_F), _OWN_LENS),)
        return _capture(place, progress, _kinects_shot, inferred=inferred)
    parts = (line.partition("=") for line in read_text(path, _MOST_INFO, _INFO_FIX).splitlines())
    info = {key.strip(): value.strip() for key, _, value in parts}
    colour, depth = _info_lens(info, "Color", path), _info_lens(info, "Depth", path)
    unit = 1.0 / _info_numbers(info, "m_depthShift", path, 1)[0]
    keys = ("m_calibrationDepthExtrinsic", "m_calibrationColorExtrinsic")
    extrinsics = [_info_numbers(info, key, path, 16).reshape(4, 4) if key in info else np.eye(4) for key in keys]
    beside, warnings = between_cameras(*extrinsics)
    if fitting_alignment(colour, depth) is None:
        fix = "Correct them; for depth that is registered to colour, write colour's lens and size for depth, too."
        raise PlgsError("lenses-differ", "the lenses of colour and depth do not belong to one sensor", path, fix)

    def shot(name: str, base: Path, pose: NDArray[np.float64], picture: Path) -> Shot:
        lens = fitted(colour, picture, f"Correct {path.name}.")
        measured = png_depth(_depth_file(base), lens, unit)
        return Shot(name, lens.at(pose), picture, seen_by_colour(measured, depth, lens, beside))

    return _capture(place, progress, shot, warnings)


def _info_numbers(info: dict[str, str], key: str, path: Path, count: int) -> NDArray[np.float64]:
    """Return a line's numbers, float64 [count]; with ``count`` 1, that must be above 0. Raises PlgsError otherwise."""
    try:
        values = np.array([float(word) for word in info.get(key, "").split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all() or (count == 1 and not 0.0 < values[0] < 1e6):
        wanted = "not a number above 0" if count == 1 else f"not {count} numbers"
        raise PlgsError("info-value", f"{key} is {wanted if key in info else 'missing'}", path, _INFO_FIX)
    return values


def _info_lens(info: dict[str, str], kind: str, path: Path) -> Camera:
    """Return the lens of "Color" or "Depth" as a camera at the origin, at the size given by the file."""
    width, height = (round(_info_numbers(info, f"m_{kind.lower()}{side}", path, 1)[0]) for side in ("Width", "Height"))
    matrix = _info_numbers(info, f"m_calibration{kind}Intrinsic", path, 16).reshape(4, 4)
    return as_lens(matrix, (width, height), path)


def _capture(
    place: Path, progress: Progress, shot: _Reader, warnings: tuple[str, ...] = (), inferred: tuple[Inferred, ...] = ()
) -> Capture:
    """Return all frames, which ``shot`` opens. A frame whose pose is missing or not finite is None."""
    kinds = ("frame-*.pose.txt", "frame-*.color.*")
    files = {path for folder in _folders(place) for kind in kinds for path in shown_files(folder, kind)}
    bases = {path.with_name(path.name.partition(".")[0]) for path in files}
    named = {
        base.name if base.parent in (place, place / "data") else f"{base.parent.name}_{base.name}": base
        for base in sorted(bases, key=lambda base: natural_order(base.relative_to(place).as_posix()))
    }
    found: list[tuple[str, Found]] = []
    pose_files = {name: base.with_name(f"{base.name}.pose.txt") for name, base in named.items()}
    poses = read_poses(pose_files, part_of(progress, 0.0, 0.5))
    for name, base in watched([*named.items()], part_of(progress, 0.5, 1.0)):
        colours = [base.with_name(f"{base.name}.color.{suffix}") for suffix in ("png", "jpg", "jpeg")]
        colour, pose = next((path for path in colours if path.is_file()), colours[0]), poses[name]
        make = None if pose is None else partial(shot, name, base, pose, colour)
        found.append((name, with_picture(colour, make)))
    return Capture(found, None, warnings, inferred=inferred)


def _depth_file(base: Path) -> Path:
    """Return the depth file of the frame whose files begin with ``base``. Raises PlgsError for a .pgm."""
    pgm = base.with_name(f"{base.name}.depth.pgm")
    if pgm.is_file():
        what = "depth in .pgm files is not read"
        raise PlgsError("depth-pgm", what, pgm, "Convert all of them, e.g. with mogrify -format png *.depth.pgm.")
    return base.with_name(f"{base.name}.depth.png")


def _own_lens_shot(lenses: tuple[Path, Path], name: str, base: Path, pose: NDArray[np.float64], picture: Path) -> Shot:
    """Return the frame ``name``, whose files begin with ``base``; ``lenses`` are the lens files of colour and depth."""
    colour, depth = lenses
    lens = read_intrinsics(colour, read_image_header(picture).size)
    measured = png_depth(_depth_file(base), lens)
    if depth != colour and measured.fault is None:
        depth_lens = read_intrinsics(depth, read_image_header(measured.path).size)
        measured = seen_by_colour(measured, depth_lens, lens, np.eye(4)) or measured
    return Shot(name, lens.at(pose), picture, measured)


def _kinects_shot(name: str, base: Path, pose: NDArray[np.float64], colour: Path) -> Shot:
    lens = fitted(_kinect(_COLOUR_F), colour, f"Write the lens, 3x3, into {_OWN_LENS}.")
    projected = base.with_name(f"{base.name}.depth.proj.png")
    if projected.is_file():
        return Shot(name, lens.at(pose), colour, png_depth(projected, lens))
    beside = inverse(_DEPTH_TO_COLOUR)
    measured = png_depth(_depth_file(base), lens)
    shown = measured.through(lambda values: registered(values, _kinect(_DEPTH_F), lens.at(beside)))
    return Shot(name, lens.at(pose @ beside), colour, shown)


def _kinect(focal_length: float) -> Camera:
    """Return a Kinect's lens with its principal point at the integer pixel (320, 240)."""
    return Camera(640, 480, focal_length, focal_length, 320.5, 240.5, np.eye(4))


FORMAT = SceneFormat(
    "7scenes",
    lambda place: place.is_dir() and any(any(shown_files(each, "frame-*.pose.txt")) for each in _folders(place)),
    _read,
)
