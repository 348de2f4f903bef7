"""Depth maps: planar metres, from 16-bit PNGs or NumPy arrays, aligned with the colour camera's picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MEMORY_IS_GONE, PlgsError
from ..job.progress import Progress, unwatched
from ..posed.array_file import array_headers, read_array, read_npy
from ..posed.frames import Camera
from ..posed.image_header import read_image_header
from ..posed.layout import check_size, files_by_stem, require_most, same_shape, shown, shown_size
from ..posed.matrices import read_intrinsics, read_matrix
from .files_of_frames import whole_file
from .frame import Inferred, Size
from .pixels import Alignment, decode_depth, read_indices, resize_aligned, resize_nearest
from .view import watched

MILLIMETRES = 0.001
_DEPTHS = (0.0005, 10_000.0)  # metres: half a step of 16 bits, and how far a camera may be from the origin
_LARGEST = 65535  # the largest value in a PNG of 16 bits
_PNG_FIX = "Save millimetres as a 16-bit grey PNG."
_ONE_PLACE = 1e-3  # metres; colour and depth share a pose if their transform differs from the identity by no more
_FARTHEST_BESIDE = 0.5  # maximum distance in metres between a sensor's two cameras
_APART = "colour and depth stand apart, but not as a sensor's do, and their extrinsics are ignored: depth may not fit"
_NEARLY_ALIGNED = 0.15  # maximum difference between a sensor's colour and depth lenses, as a fraction of the picture


@dataclass(frozen=True, eq=False)
class DepthMap:
    """One frame's depth, in the file ``path``. ``read`` returns planar depth, float32 [H, W] metres with 0 = none, at
    its own size. ``alignment`` maps colour pixels to depth pixels. ``fault`` is the error if the header shows that the
    file is unreadable. ``step`` is a value's unit in metres, None for files that store lengths. ``confidence`` is the
    file that says which pixels to trust. ``beside`` is the depth camera's pose in the colour's axes, () if equal."""

    path: Path
    read: Callable[[], NDArray[np.float32]]
    alignment: Alignment = Alignment()
    fault: PlgsError | None = None
    step: float | None = None
    confidence: Path | None = None
    beside: tuple[float, ...] = ()

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Read depth, float32 [H, W] in metres with 0 = none, in the colour picture at ``size`` (width, height), or at
        the map's own size. Raises PlgsError if the file is missing or damaged."""
        depth = self.read()
        return resize_aligned(depth, size or (depth.shape[1], depth.shape[0]), self.alignment)

    @property
    def unusual(self) -> tuple[float, ...]:
        """The unit, alignment and pose; () if the unit is millimetres and the colour camera took the depth."""
        is_usual = self.step in (None, MILLIMETRES) and self.alignment == Alignment()
        usual = () if is_usual else (float(self.step or 0.0), *map(float, astuple(self.alignment)))
        return (*usual, *self.beside)

    def through(self, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> DepthMap:
        """Return the same map with ``change`` applied after reading."""
        return replace(self, read=lambda: change(self.read()))


def png_depth(path: Path, lens: Camera, unit: float = MILLIMETRES) -> DepthMap:
    """Open the depth in a 16-bit grey PNG for the colour camera ``lens``, in steps of ``unit`` metres; only its header
    is read. Raises PlgsError for other kinds of images. The largest value means no depth, as 0 does: sensors write it
    where they measured nothing, and where a surface is beyond the PNG's range."""
    fault = fault_of(path)
    if fault is not None:
        return DepthMap(path, partial(_read_png, path, unit), fault=fault, step=unit)
    header = read_image_header(path)
    is_grey = header.channels == 1 or (header.channels == 3 and header.bit_depth == 16)  # see ``decode_depth``
    if header.format != "png" or not is_grey or header.palette:
        raise PlgsError("depth-png", "depth is not a grey PNG", path, _PNG_FIX)
    if header.bit_depth != 16:
        raise PlgsError("depth-bits", f"depth has {header.bit_depth} bits, not 16", path, _PNG_FIX)
    if not same_shape(header.size, lens.size):
        what = f"depth of {shown_size(header.size)} does not fit the colour image of {shown_size(lens.size)}"
        raise PlgsError("depth-shape", what, path, "Bring depth to the colour images' aspect ratio.")
    return DepthMap(path, partial(_read_png, path, unit), step=unit)


def fault_of(path: Path) -> PlgsError | None:
    """Return an error that tells why a file is empty or cut off, else None. Raises PlgsError if memory is full."""
    try:
        whole_file(path)
    except PlgsError as error:
        if MEMORY_IS_GONE in error.what:
            raise
        return error
    return None


def _read_png(path: Path, unit: float) -> NDArray[np.float32]:
    steps = decode_depth(path, _PNG_FIX)
    if steps.dtype != np.uint16:
        raise PlgsError("depth-png", "depth is not a 16-bit grey PNG", path, _PNG_FIX)
    steps[steps == _LARGEST] = 0
    return steps * np.float32(unit)


def npy_depth(path: Path, step: float | None = None) -> DepthMap:
    """Open the depth in a .npy file, in steps of ``step`` metres; None: floats are metres, integers millimetres."""

    def read() -> NDArray[np.float32]:
        values = read_depth_array(path)
        return in_metres(values) if step is None else only_depth(values.astype(np.float32) * np.float32(step))

    return DepthMap(path, read, fault=fault_of(path))


def read_depth_array(path: Path) -> NDArray[Any]:
    """Read numbers [H, W] from a .npy, or an .npz's "depth" (or only) array. Raises PlgsError for other files."""
    if path.suffix.lower() == ".npz":
        arrays = list(array_headers(path))
        values = read_array(path, "depth" if len(arrays) != 1 else arrays[0])
    else:
        values = read_npy(path, "Save one array with numpy.save.")
    while values.ndim > 2 and 1 in (values.shape[0], values.shape[-1]):  # [1, H, W] or [H, W, 1] of networks
        values = values[0] if values.shape[0] == 1 else values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        raise PlgsError("depth-array", "depth is not one array of numbers", path, "Save an array [height, width].")
    return values


def in_metres(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return depth, float32 [H, W] metres (``only_depth``), from metres as floats or millimetres as integers."""
    return only_depth(values.astype(np.float32) * np.float32(1.0 if values.dtype.kind == "f" else MILLIMETRES))


def only_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ``depth`` with 0 in place of all values that are not finite and positive."""
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))


def trusted(depth: DepthMap, confidence: Path | None) -> DepthMap:
    """Return ``depth`` without the pixels whose ``confidence`` is 0, the lowest of ARKit's levels."""
    if confidence is None:
        return depth
    shown = depth.through(lambda values: drop_untrusted(values, read_indices(confidence), confidence))
    return replace(shown, confidence=confidence)


def drop_untrusted(depth: NDArray[np.float32], level: NDArray[np.integer], path: Path) -> NDArray[np.float32]:
    """Return ``depth`` [H, W] with 0 wherever ``level`` [H, W] is 0. Raises PlgsError if their sizes differ."""
    if depth.shape != level.shape:
        what = "confidence and depth differ in size"
        raise PlgsError("other-size", what, path, "Remove the confidence, or copy it again.")
    return np.where(level > 0, depth, np.float32(0.0))


def depth_check(name: str, path: Path) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return a function that checks planar depth, float32 [H, W] metres with 0 = none, and returns it unchanged. It
    raises PlgsError, with the frame's ``name`` and the file ``path``, for a size or lengths that no sensor gives."""

    def check(depth: NDArray[np.float32]) -> NDArray[np.float32]:
        check_size(f"depth of frame {shown(name)}", (depth.shape[1], depth.shape[0]), path)
        farthest = float(depth.max())
        if farthest > 0.0 and not _DEPTHS[0] <= farthest <= _DEPTHS[1]:
            what = f"the largest depth of frame {shown(name)} is {farthest:.4g} m, which no sensor measures"
            fix = "Give depth in metres as floats, or in millimetres as whole numbers."
            raise PlgsError("depth-far", what, path, fix)
        return depth

    return check


def registered(depth: NDArray[np.float32], camera: Camera, colour: Camera) -> NDArray[np.float32]:
    """Reproject depth [H, W], measured by ``camera``, into the ``colour`` camera beside it; metres, 0 = none."""
    height, width = depth.shape
    points = camera.resized(width, height).unproject(depth)[depth > 0.0]
    _, pixels, z = colour.resized(width, height).seen(points)
    columns, rows = pixels.astype(np.int64).T
    nearest = np.full(height * width, np.inf, np.float32)
    # Of all surfaces that fall into a pixel, the nearest hides the others.
    np.minimum.at(nearest, rows * width + columns, z.astype(np.float32))
    nearest[np.isinf(nearest)] = 0.0
    return nearest.reshape(height, width)


def open_depth(
    scene: Path, lenses: Mapping[str, Camera], progress: Progress
) -> tuple[dict[str, DepthMap], tuple[Inferred, ...]]:
    """Open the depth maps in a scene's folder ``depth``; only headers are read. ``lenses`` are the colour cameras by
    frame. Returns the maps by frame, and what was inferred about their lens. Raises PlgsError if most have no map."""
    folder = scene / "depth"
    files = files_by_stem(folder, {".png"}, "Give 16-bit PNGs in millimetres, named like the colour images.")
    fix = "Add depth/<name>.png, or remove their colour images."
    there = require_most(list(lenses), files, "depth", folder, fix)
    maps = {name: png_depth(files[name], lenses[name]) for name in watched(there, progress)}
    path, beside_path, of_colour = (
        next((each for each in (scene / "intrinsic" / f"{name}.txt", scene / f"{plural}.txt") if each.is_file()), None)
        for name, plural in (
            ("intrinsic_depth", "intrinsics_depth"), ("extrinsic_depth", "extrinsics_depth"),
            ("extrinsic_color", "extrinsics_color"),
        )
    )  # fmt: skip
    whole = [each.path for each in maps.values() if each.fault is None]
    if not whole or (path is None and beside_path is None):
        return maps, ()
    extrinsics = [np.eye(4) if each is None else read_matrix(each, ((4, 4),)) for each in (beside_path, of_colour)]
    beside, warnings = between_cameras(*extrinsics)
    size = Counter(read_image_header(each).size for each in whole).most_common(1)[0][0]
    depth_lens = None if path is None else read_intrinsics(path, size)
    own = {name for name in lenses if (scene / "intrinsic" / f"{name}.txt").is_file()}  # these lenses hold for depth
    found = {
        name: seen_by_colour(one, (None if name in own else depth_lens) or lenses[name], lenses[name], beside)
        for name, one in maps.items()
    }
    parts = (warning.partition(": ") for warning in warnings)
    inferred = tuple(Inferred("depth's lens", taken, reason) for taken, _, reason in parts)
    fitting = {name: one for name, one in found.items() if one is not None}
    if len(fitting) == len(maps) or path is None:
        return fitting, inferred
    taken = f"{path.name} is ignored, and depth is assumed to fit the colour"
    return maps, (*inferred, Inferred("depth's lens", taken, "it does not fit the colour intrinsics"))


def between_cameras(
    depth: NDArray[np.float64], colour: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the transform from points of the depth camera to points of the colour camera, float64 [4, 4], and warnings
    if they stand too far apart for a sensor. The arguments are both extrinsics of ScanNet (its calibration's
    ``depthToColor``)."""
    is_rigid = np.isfinite(depth).all() and np.abs(depth[:3, :3] @ depth[:3, :3].T - np.eye(3)).max() < 0.01
    if np.abs(colour - depth).max() < _ONE_PLACE:
        return np.eye(4), ()
    if not is_rigid or np.abs(depth[:3, 3]).max() > _FARTHEST_BESIDE or np.abs(colour - np.eye(4)).max() > _ONE_PLACE:
        return np.eye(4), (_APART,)
    return depth, ()


def seen_by_colour(depth: DepthMap, lens: Camera, colour: Camera, beside: NDArray[np.float64]) -> DepthMap | None:
    """Return depth that a camera with ``lens`` measured as the ``colour`` camera sees it; None if the two pictures
    differ by more than any sensor's. ``beside`` float64 [4, 4] maps points of the one camera to the other."""
    alignment = fitting_alignment(colour, lens)
    if alignment is None or np.abs(beside - np.eye(4)).max() < _ONE_PLACE:
        return None if alignment is None else replace(depth, alignment=alignment)
    shown = depth.through(lambda values: registered(values, lens.at(beside), colour.at(np.eye(4))))
    return replace(shown, beside=(*beside.ravel().tolist(),))


def fitting_alignment(colour: Camera, depth: Camera) -> Alignment | None:
    """Return the alignment of a colour camera with a depth camera at the same centre; None if the pictures differ by
    more than any sensor's. Both see the ray (x, y, 1) at u = f x + c, so depth's u is a linear function of colour's."""
    x_scale = (depth.fx / depth.width) / (colour.fx / colour.width)
    y_scale = (depth.fy / depth.height) / (colour.fy / colour.height)
    x_shift = depth.cx / depth.width - x_scale * colour.cx / colour.width
    y_shift = depth.cy / depth.height - y_scale * colour.cy / colour.height
    # How far the picture's edges move, in shares of its size.
    moves = max(abs(x_shift), abs(x_scale + x_shift - 1.0), abs(y_shift), abs(y_scale + y_shift - 1.0))
    if moves < 1e-4:  # the same lens with other digits must not lose a row of pixels to rounding
        return Alignment()
    return Alignment(x_scale, x_shift, y_scale, y_shift) if moves < _NEARLY_ALIGNED else None


_TOLERANCE = 0.1  # metres, or 5 % of the depth if that is more: thumbnails of slanted surfaces are coarse
_NEXT, _SPREAD = 3, 24
_THUMBNAIL_WIDTH = 40
_OVERLAPPING = 0.05
_LOOKED_AT = 0.2


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A frame's name, camera and depth, float32 [H, W] metres (0 = none), at a small size, for comparing frames."""

    name: str
    camera: Camera
    depth: NDArray[np.float32]

    @classmethod
    def of(cls, name: str, camera: Camera, depth: NDArray[np.float32]) -> Thumbnail:
        """Reduce a frame's depth, float32 [H, W] in metres, to a thumbnail."""
        size = (_THUMBNAIL_WIDTH, max(1, round(_THUMBNAIL_WIDTH * camera.height / camera.width)))  # not 0 for panoramas
        return cls(name, camera.resized(*size), resize_nearest(depth, size))


@dataclass(frozen=True)
class Overlap:
    """How well frames fit together: the cheapest test that poses, intrinsics and depth belong together (equation
    "ProjectionEquation" of the paper, with a depth test). ``lonely`` names frames that share less than 5 % of their
    pixels with every frame they were compared with; ``overlaps`` says whether any two frames share more. ``agreement``
    is the median over pairs of frames of the fraction of points that have the expected depth; pairs count if at least a
    fifth of one frame's points project into the other."""

    lonely: tuple[str, ...]
    overlaps: bool
    agreement: float


def compared(count: int) -> list[tuple[int, int]]:
    """Return the pairs of ``count`` frames to compare: each with the next three, and 24 spread ones with each other."""
    spread = np.unique(np.linspace(0, count - 1, min(count, _SPREAD)).round().astype(int)).tolist()
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _NEXT, count))}
    return sorted(pairs | {*combinations(spread, 2)})


def measure_overlap(
    thumbnails: Sequence[Thumbnail], progress: Progress = unwatched, tolerance: float = _TOLERANCE
) -> Overlap:
    """Compare every frame with the next three, and 24 frames spread over the scene with each other. Depths agree within
    ``tolerance`` metres, or 5 %. ``progress`` is called with (done, total) in frames."""
    best = np.zeros(len(thumbnails))
    agreements = []
    for i, j in compared(len(thumbnails)):
        progress(i, len(thumbnails))
        inside, agreeing = _share_seen(thumbnails[i], thumbnails[j], tolerance)
        best[i], best[j] = max(best[i], agreeing), max(best[j], agreeing)
        if inside >= _LOOKED_AT:
            agreements.append(agreeing / inside)
    return Overlap(
        lonely=tuple(thumbnail.name for thumbnail, share in zip(thumbnails, best, strict=True) if share < _OVERLAPPING),
        overlaps=bool(best.max(initial=0.0) >= _OVERLAPPING),
        agreement=float(np.median(agreements)) if agreements else 0.0,
    )


def _share_seen(one: Thumbnail, other: Thumbnail, tolerance: float) -> tuple[float, float]:
    """Return the fraction of one frame's points that hit depth of the other, and the fraction that agrees with it."""
    valid = one.depth > 0.0
    points = one.camera.unproject(one.depth)[valid]
    if not len(points):
        return 0.0, 0.0
    _, pixels, expected = other.camera.seen(points)
    columns, rows = pixels.astype(np.int64).T
    seen = other.depth[rows, columns]
    agrees = (seen > 0.0) & (np.abs(seen - expected) <= np.maximum(tolerance, 0.05 * expected))
    return float((seen > 0.0).sum() / len(points)), float(agrees.sum() / len(points))
