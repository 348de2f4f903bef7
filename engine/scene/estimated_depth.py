"""Fit monocular depth maps to a reconstruction's sparse points: the paper's path for estimated depth. A network's map
of one picture is correct up to a scale and a shift, of depth or of its inverse; both follow from the points' depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job.progress import Progress, unwatched
from ..posed.image_header import read_image_header
from .depth import DepthMap, Thumbnail, depth_check, in_metres, measure_overlap, read_depth_array
from .files_of_frames import files_of_frames, mask_files
from .frame import Frame, Inferred, LeftOut, SparsePoints, left_out
from .frame_choice import evenly_spread
from .mask_fit import Pictured, Placement, other_numbers, turns_of
from .pixels import decode_depth, values_at

_AS_METRES = "depth maps are read as metres (.png: millimetres)"
_BENT = Inferred(
    "masks' lens", "depth maps are straightened as the photos are", "they are taken for maps of the photos as they are"
)
_TURNED = Inferred(
    "orientation", "depth maps of photos with an EXIF orientation are turned to the stored pictures",
    "they fit the points so",
)  # fmt: skip
_CLEARLY = 0.7  # an alternative reading of the maps is taken if its error is at most this fraction of the usual one's
_AGREEING = 0.35
"""Maps with values up to 1 are metres if this fraction of the points agrees between frames. Of two scenes shrunk to
1 m, 0.57 and 0.92 agreed; as fractions of each frame's range, or in half or twice their unit, at most 0.21."""
_COMPARED = 24
_ARRAYS = {".npy", ".npz"}
_LOOKED_AT = 8
LEAST_POINTS = 12  # a frame needs at least this many visible points to get depth
_FIX = "Give one map per frame, with the frame's name: .npy, .npz, or .png of 8 or 16 bits."
_PAIRS = 256
_MOST_POINTS = 2000
_CLOSE = 0.01
_FARTHEST = 3.0  # a multiple of the farthest point's depth; depth beyond it is a guess, and is dropped

Values = NDArray[np.float64]


@dataclass(frozen=True)
class DepthFit:
    """How a map's values become depth: ``scale`` * value + ``shift``, or 1 / that if ``is_inverse``, up to
    ``farthest``. ``error`` is the points' median error relative to their depth."""

    scale: float
    shift: float
    is_inverse: bool
    farthest: float
    error: float

    def depth(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Return the depth of a map's values [...], float32 [...], 0 = none."""
        line = self.scale * values.astype(np.float64) + self.shift
        depth = np.divide(1.0, line, out=np.zeros_like(line), where=line > 1e-9) if self.is_inverse else line
        good = np.isfinite(depth) & (depth > 0.0) & (depth <= self.farthest)
        return np.where(good, depth, 0.0).astype(np.float32)


def fit_depth(values: Values, depths: Values) -> DepthFit | None:
    """Find the scale and shift that turn a map's ``values`` [N] into the known ``depths`` [N] (> 0) or their inverse.
    Up to half of the points may be wrong: of the lines through two points, the one with the smallest median error is
    refined on the points that agree with it. Returns None if no line rises."""
    good = np.isfinite(values) & np.isfinite(depths) & (depths > 0.0)
    values, depths = values[good], depths[good]
    if len(values) < LEAST_POINTS:
        return None
    step = -(-len(values) // _MOST_POINTS)  # rounded up, so that no more are left
    values, depths = values[::step], depths[::step]
    fits = [fit for inverse in (False, True) if (fit := _fit_line(values, depths, inverse)) is not None]
    return min(fits, key=lambda fit: fit.error, default=None)


def _fit_line(values: Values, depths: Values, inverse: bool) -> DepthFit | None:
    target = 1.0 / depths if inverse else depths
    one, other = np.random.default_rng(0).integers(0, len(values), (2, _PAIRS))  # the same each time
    run = values[one] - values[other]
    usable = np.abs(run) > 1e-9 * max(1.0, float(np.abs(values).max()))  # two equal values give no slope
    scales = np.divide(target[one] - target[other], run, out=np.zeros(_PAIRS), where=usable)
    scales = np.where(scales > 0.0, scales, np.nan)  # falling lines belong to the inverse, or to the depth
    shifts = target[one] - scales * values[one]
    errors = np.median(_relative_errors(values, depths, scales[:, None], shifts[:, None], inverse), axis=1)
    if not np.isfinite(errors).any():
        return None
    best = int(np.argmin(np.where(np.isfinite(errors), errors, np.inf)))
    scale, shift = float(scales[best]), float(shifts[best])
    for _ in range(3):  # each line has other points that agree
        scale, shift = _refined(values, depths, scale, shift, inverse)
    error = float(np.median(_relative_errors(values, depths, scale, shift, inverse)))
    if not scale > 0.0 or not np.isfinite(error):
        return None
    return DepthFit(scale, shift, inverse, _FARTHEST * float(depths.max()), error)


def _relative_errors(values: Values, depths: Values, scale: Any, shift: Any, inverse: bool) -> Values:
    """Return the errors, relative to ``depths``, of the depth that ``values`` get by scale and shift; inf for none."""
    line = scale * values + shift
    with np.errstate(divide="ignore", invalid="ignore"):
        found = 1.0 / line if inverse else line
        return np.where(line > 0.0, np.abs(found / depths - 1.0), np.inf)


def _refined(values: Values, depths: Values, scale: float, shift: float, inverse: bool) -> tuple[float, float]:
    """Return scale and shift refined by least squares of the relative errors, over the points that agree with them.
    With ``inverse`` they give 1 / depth."""
    errors = _relative_errors(values, depths, scale, shift, inverse)
    near = errors <= max(_CLOSE, 3.0 * float(np.median(errors)))
    weight = depths[near] if inverse else 1.0 / depths[near]  # makes all targets 1, so that errors are relative
    rows = np.stack([values[near] * weight, weight], axis=-1)
    solution, _, rank, _ = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)
    return (float(solution[0]), float(solution[1])) if rank == 2 else (scale, shift)  # rank 1: equal values


def fitted_map(
    path: Path, placement: Placement, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Fit a map to points of known ``depths`` [N], and return its depth, float32 [H, W] in the world's unit, 0 = none.
    ``pixels`` [N, 2] are the points' x and y as fractions of the picture. Raises PlgsError if nothing fits."""
    values = _placed(path, placement)
    fit = fit_depth(values_at(values, pixels).astype(np.float64), depths)
    if fit is None:
        what = "the depth map does not follow the depth of the reconstruction's points"
        raise PlgsError("depth-unrelated", what, path, "Check that it belongs to this frame, or leave the frame out.")
    return fit.depth(values)


def _metric_map(path: Path, placement: Placement) -> NDArray[np.float32]:
    return np.asarray(placement(in_metres(read_map(path))))


def _placed(path: Path, placement: Placement) -> NDArray[np.float32]:
    """Read a map placed in the picture, float32 [H, W], NaN beyond the photo's edges. Raises PlgsError if it is bad."""
    values = read_map(path).astype(np.float32)
    shows = placement(np.ones(values.shape, np.int32))  # 0 may be a value of the map, so it cannot tell
    return np.where(shows > 0, placement(values), np.float32(np.nan))


def read_map(path: Path) -> NDArray[Any]:
    """Read a map as it is stored, numbers [H, W]. Raises PlgsError for files that hold no map."""
    if path.suffix.lower() in _ARRAYS:
        return read_depth_array(path)
    return decode_depth(path, _FIX)


def with_estimated_depth(
    frames: Sequence[Frame], folder: Path, points: SparsePoints | None, pictured: Mapping[str, Pictured],
    progress: Progress = unwatched,
) -> tuple[tuple[Frame, ...], tuple[LeftOut, ...], tuple[Inferred, ...]]:  # fmt: skip
    """Return the frames with depth from the maps in ``folder``, those left out because they see too few points, and
    what was inferred. ``pictured``: see ``mask_fit``. Maps are read on demand, except a few that are inspected at once.
    Raises PlgsError if a map is missing, or no frame is left."""
    names = [frame.name for frame in frames]
    # Networks write pictures to look at beside their arrays; a few arrays beside maps are something else.
    arrays = mask_files(folder, *_ARRAYS)
    kinds = _ARRAYS if arrays and (2 * len(arrays) >= len(names) or not mask_files(folder, ".png")) else {".png"}
    find = partial(files_of_frames, folder, suffixes=kinds, what="depth map", fix=_FIX, progress=progress)
    has_points, error = points is not None and len(points) > 0, None
    try:
        files: Mapping[str, Path] = find(names)
    except PlgsError as raised:
        if raised.key != "lacks-files" or not has_points:
            raise
        files, error = {}, raised  # maps may be numbered otherwise, see _fitting
    for path in files.values():
        bits = read_image_header(path).bit_depth if path.suffix.lower() == ".png" else 16
        if bits < 16 and not has_points:
            what = "an 8-bit map holds no lengths, and there are no sparse points to fit it to"
            fix = "Give a 16-bit .png in millimetres, a .npy in metres, or COLMAP's points."
            raise PlgsError("depth-bits", what, path, fix)
    usual = {name: Placement(lens=pictured[name].lens) for name in names}
    seen = {frame.name: seen_points(frame, points) for frame in frames} if points is not None and has_points else {}
    inferred: tuple[Inferred, ...] = ()
    if seen:
        files, usual, inferred = _fitting(partial(find, progress=unwatched), files, usual, pictured, seen)
        if error is not None and not files:
            raise error
    else:
        inferred = (_as_metres(frames, files, usual), *([_BENT] if any(each.lens for each in usual.values()) else []))
    mapless = left_out("a readable depth map", [name for name in names if name not in files])
    kept, blind = [], []
    for frame in (frame for frame in frames if frame.name in files):
        place = usual[frame.name]
        if not seen:
            kept.append(_with_depth(frame, files[frame.name], partial(_metric_map, placement=place)))
            continue
        pixels, depths = seen[frame.name]
        if len(depths) < LEAST_POINTS:
            blind.append(frame.name)
            continue
        read = partial(fitted_map, placement=place, pixels=pixels, depths=depths)
        kept.append(_with_depth(frame, files[frame.name], read))
    if seen and not any(not frame.held_out for frame in kept):
        fix = f"Each needs {LEAST_POINTS} points: take more photos, or give a mesh with --depth."
        raise PlgsError("few-points", "no frame to train on sees enough points to fit depth to", folder, fix)
    return tuple(kept), (*mapless, *left_out(f"{LEAST_POINTS} points of the reconstruction in view", blind)), inferred


def _as_metres(frames: Sequence[Frame], files: Mapping[str, Path], placements: Mapping[str, Placement]) -> Inferred:
    """Return a note that the maps are read as metres. Float maps with values up to 1 may show a tabletop, or be
    relative depth without a unit (Marigold); the frames then disagree, and PlgsError is raised."""
    thumbnails = []
    for frame in evenly_spread([frame for frame in frames if frame.name in files], _COMPARED):
        values = read_map(files[frame.name])
        depth = np.asarray(placements[frame.name](in_metres(values)))
        if values.dtype.kind != "f" or depth.max() > 1.0 or depth.max() == depth.min():
            return Inferred("units", _AS_METRES, "there are no sparse points to fit depth to")
        thumbnails.append(Thumbnail.of(frame.name, frame.camera, depth))
    share = measure_overlap(thumbnails, tolerance=0.0).agreement  # in so small a scene, 10 cm say nothing
    if share < _AGREEING:
        what = f"depth maps hold values from 0 to 1, and as metres the frames contradict each other ({share:.0%} agree)"
        fix = "Save depth as 16-bit .png in millimetres; for relative depth, give COLMAP's poses and points."
        raise PlgsError("depth-relative", what, next(iter(files.values())), fix)
    return Inferred("units", _AS_METRES, f"{share:.0%} of the points agree between frames then")


def _fitting(
    find: Callable[[list[str]], Mapping[str, Path]],
    files: Mapping[str, Path],
    usual: dict[str, Placement],
    pictured: Mapping[str, Pictured],
    seen: Mapping[str, tuple[Values, Values]],
) -> tuple[Mapping[str, Path], dict[str, Placement], tuple[Inferred, ...]]:
    """Return the pairing of frames and maps, the maps' placements, and what was inferred. If another pairing or
    placement fits the points ``seen`` clearly better than ``files`` and ``usual``, it is returned, else these. ``find``
    returns the maps of other frame names."""
    ways: list[tuple[Mapping[str, Path], dict[str, Placement], tuple[Inferred, ...]]] = []
    bent = any(each.lens for each in usual.values())
    straight = {name: Placement() for name in usual}
    pairings: list[tuple[str, Mapping[str, Path]]] = [("", files)]
    if len(files) < len(usual):
        for how, others in other_numbers([*usual]):
            try:
                found = find([*others.values()])
            except PlgsError:
                continue
            pairings.append((how, {name: found[other] for name, other in others.items() if other in found}))
    turns = {name: turns_of(pictured[name].orientation) for name in usual}
    for how, paired in pairings:
        of_numbers = Inferred("numbering", f"depth maps are paired with frames {how}", "they fit the points so")
        for is_turned in (False, True) if any(turns.values()) else (False,):
            for placements in (usual, straight) if bent else (usual,):
                placed = {name: replace(one, turns=turns[name] * is_turned) for name, one in placements.items()}
                said = [(of_numbers, how), (_TURNED, is_turned), (_BENT, bent and placements is usual)]
                ways.append((paired, placed, tuple(each for each, is_so in said if is_so)))
    if len(ways) == 1:
        return ways[0]
    errors = [_error(paired, placed, seen) for paired, placed, _ in ways]
    best = int(np.argmin(errors))
    return ways[best] if errors[best] < _CLEARLY * errors[0] else ways[0]


def _error(
    files: Mapping[str, Path], placements: Mapping[str, Placement], seen: Mapping[str, tuple[Values, Values]]
) -> float:
    """Return the median relative error of ``files``' depth at the points ``seen`` in some frames; 1 if none fits."""
    errors = []
    for name in evenly_spread([name for name in files if len(seen[name][1]) >= LEAST_POINTS], _LOOKED_AT):
        pixels, depths = seen[name]
        fit = fit_depth(values_at(_placed(files[name], placements[name]), pixels).astype(np.float64), depths)
        errors.append(1.0 if fit is None else fit.error)
    return float(np.median(errors)) if errors else 1.0


def _with_depth(frame: Frame, path: Path, read: Callable[[Path], NDArray[np.float32]]) -> Frame:
    depth, kept = DepthMap(path, partial(read, path)), frame.read_kept
    if kept is not None:
        depth = depth.through(lambda values: values * kept((values.shape[1], values.shape[0])))
    return replace(frame, depth_path=path, read_depth=depth.through(depth_check(frame.name, path)))


def seen_points(frame: Frame, points: SparsePoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels [N, 2] of the points that a frame sees, x and y as fractions of the picture, and their depths
    [N]. In formats without tracks, all points in view count."""
    xyz = points.xyz[points.seen_by.get(frame.name, np.zeros(0, np.int64))] if points.seen_by else points.xyz
    _, pixels, depths = frame.camera.seen(xyz)
    return pixels / frame.camera.size, depths
