"""Depth images: 16-bit PNGs along the optical axis, in millimetres unless a format says otherwise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .frame import SceneError, Size
from .image_header import read_image_header
from .layout import files_by_stem, require_all, same_shape, shown_size
from .matrices import read_intrinsics
from .pixels import Alignment, decode, resize_aligned

MILLIMETRES = 0.001
_NEARLY_ALIGNED = 0.15
"""Largest difference, in shares of the picture, of lenses that one sensor's colour and depth may have."""


@dataclass(frozen=True)
class DepthReader:
    """Reads one frame's depth into the frame of its colour image.

    ``unit`` is the length of one step in metres; values from ``none_from`` on mean no depth, as 0 does.
    """

    path: Path
    alignment: Alignment = Alignment()
    unit: float = MILLIMETRES
    none_from: int = 65536

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none, at ``size`` (width, height) or its own. Raises SceneError."""
        steps = decode(self.path, as_colour=False)
        if steps.ndim != 2 or steps.dtype != np.uint16:
            raise SceneError("depth is not a 16-bit grey PNG", self.path, "Save millimetres with 16 bits.")
        if self.none_from < 65536:
            steps[steps >= self.none_from] = 0
        height, width = steps.shape
        return resize_aligned(steps, size or (width, height), self.alignment) * np.float32(self.unit)


@dataclass(frozen=True)
class DepthSet:
    """Readers by frame, and warnings."""

    readers: Mapping[str, DepthReader]
    warnings: tuple[str, ...] = ()


def open_depth(scene: Path, lenses: Mapping[str, Camera]) -> DepthSet:
    """Open the depth images of frames whose colour cameras are ``lenses``; headers only. Raises SceneError."""
    folder = scene / "depth"
    files = files_by_stem(folder, {".png"}, "Give 16-bit PNGs in millimetres, named like the colour images.")
    names = list(lenses)
    require_all(names, files, "depth", folder, "Add depth/<name>.png, or take their colour images away.")
    sizes = {name: check_depth_header(files[name], lenses[name]) for name in names}
    path = scene / "intrinsic" / "intrinsic_depth.txt"
    if not path.is_file():
        return DepthSet({name: DepthReader(files[name]) for name in names})
    depth_lens = read_intrinsics(path, Counter(sizes.values()).most_common(1)[0][0])
    own = {name for name in names if (scene / "intrinsic" / f"{name}.txt").is_file()}
    alignments = {name: Alignment() if name in own else _alignment(lenses[name], depth_lens) for name in names}
    if all(_is_plausible(alignment) for alignment in alignments.values()):
        return DepthSet({name: DepthReader(files[name], alignments[name]) for name in names})
    warning = f"{path.name} does not fit the colour intrinsics and is ignored: depth is taken to lie on the colour"
    return DepthSet({name: DepthReader(files[name]) for name in names}, (warning,))


def check_depth_header(path: Path, lens: Camera) -> Size:
    """The size of a depth image for the colour camera ``lens``. Raises SceneError unless it is a 16-bit grey PNG."""
    header = read_image_header(path)
    if header.format != "png" or header.channels != 1 or header.palette:
        raise SceneError("depth is not a grey PNG", path, "Save millimetres as a 16-bit grey PNG.")
    if header.bit_depth != 16:
        raise SceneError(f"depth has {header.bit_depth} bits, not 16", path, "Save millimetres as a 16-bit grey PNG.")
    colour = (lens.width, lens.height)
    if not same_shape(header.size, colour):
        raise SceneError(
            f"depth of {shown_size(header.size)} does not fit the colour of {shown_size(colour)}",
            path,
            "Bring depth to the colour images' aspect ratio.",
        )
    return header.size


def fitting_alignment(colour: Camera, depth: Camera) -> Alignment | None:
    """Where a depth camera with the same centre sees what the colour camera does; None when no sensor is built so."""
    alignment = _alignment(colour, depth)
    return alignment if _is_plausible(alignment) else None


def _alignment(colour: Camera, depth: Camera) -> Alignment:
    """Both see the ray (x, y, 1): u = f x + c in either, so that depth's u is a linear function of colour's."""
    x_scale = (depth.fx / depth.width) / (colour.fx / colour.width)
    y_scale = (depth.fy / depth.height) / (colour.fy / colour.height)
    found = Alignment(
        x_scale,
        depth.cx / depth.width - x_scale * colour.cx / colour.width,
        y_scale,
        depth.cy / depth.height - y_scale * colour.cy / colour.height,
    )
    # The same lens written with other digits must not lose a row of pixels to rounding.
    return Alignment() if _largest_shift(found) < 1e-4 else found


def _largest_shift(alignment: Alignment) -> float:
    """How far the picture's edges move, in shares of its size."""
    return max(
        abs(alignment.x_shift),
        abs(alignment.x_scale + alignment.x_shift - 1.0),
        abs(alignment.y_shift),
        abs(alignment.y_scale + alignment.y_shift - 1.0),
    )


def _is_plausible(alignment: Alignment) -> bool:
    return _largest_shift(alignment) < _NEARLY_ALIGNED
