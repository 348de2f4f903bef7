"""Check whether pictures belong to depth and poses: depth's edges, moved and scaled, should lie on edges of the
pictures, and a surface should have the same grey value in two pictures."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..posed.layout import plural
from ..scene import evenly_spread
from ..scene.pixels import values_at
from .findings import FIX, Finding, edges_on, side_by_side
from .reprojection import Assumption, Examined, Floats, Gain, Look, Photo
from .trials import Calibration

_MOST = 32  # maximum number of looks used
_WIDTH = 160
_FARTHEST = 0.12  # largest shift tried, as a fraction of the width
_SCALES = (1.0, 0.97, 1.03, 0.94, 1.06, 0.91, 1.1, 0.88, 1.14, 0.84, 1.19, 0.8, 1.25)
_JUMP = 0.06  # least relative step of depth between two pixels at an edge, beyond the step of a slanted surface
_LEAST_EDGES = 60
_LEAST_LOOKS = 5
_AHEAD, _APART = 2.0, 0.1  # metres; looks show different places if points 2 m ahead of their cameras are this far apart
_CERTAIN = 5.0  # standard errors among the frames
_CORROBORATED = 4.0  # standard errors that suffice if depth's own geometry agrees
_MOVED, _SCALED = 0.0075, 0.03  # fraction of the width, and scale; sensors' colour and depth fit to a few pixels of 640
_GAIN = 0.1  # least gain of a fit, in standard deviations of the pictures' contrast

SHIFT = "colour-to-depth shift"  # the name of the finding

Shift = tuple[float, float]  # x, y as fractions of the picture


class Registration(NamedTuple):
    """Where depth's edges fit the pictures best: an edge at p (fractions of the picture) belongs at (p - 0.5) *
    ``scale`` + 0.5 + ``shift``. ``gain`` is how much stronger the pictures' contrast is there than at depth's own
    position, in standard deviations. ``certainty`` is the gain over its standard error among the ``frames`` with
    edges."""

    scale: float
    shift: Shift
    gain: float
    certainty: float
    frames: int


def measure_registration(looks: list[Look], photos: dict[int, Photo]) -> Registration | None:
    """Find the scale and shift that bring depth's edges onto those of ``photos`` (by frame); None with too few."""
    chosen: list[Look] = []  # at most 32 looks spread over the recording, each of a different place
    seen: list[Floats] = []
    for look in evenly_spread([look for look in looks if look.number in photos], _MOST):
        pose = look.camera.camera_to_world
        aim = pose[:3, 3] + _AHEAD * pose[:3, 2]
        if all(np.linalg.norm(aim - other) > _APART for other in seen):
            chosen.append(look)
            seen.append(aim)
    pairs = []
    for look in chosen:
        edges = _depth_edges(look.depth)
        if len(edges) >= _LEAST_EDGES:
            pairs.append((edges, _contrast(photos[look.number].grey)))
    if len(pairs) < _LEAST_LOOKS:
        return None
    coarse = max((_coarse(pairs, scale) for scale in _SCALES), key=lambda found: found[0])
    scale, shift = _refined(pairs, coarse[1], coarse[2])
    gains = _fits(pairs, scale, shift) - _fits(pairs, 1.0, (0.0, 0.0))
    error = max(float(gains.std(ddof=1)) / np.sqrt(len(gains)), 1e-6)
    return Registration(scale, shift, float(gains.mean()), float(gains.mean()) / error, len(pairs))


def _depth_edges(depth: NDArray[np.float32]) -> Floats:
    """Return where depth jumps between two pixels, float64 [N, 2] as fractions of the picture."""
    height, width = depth.shape
    found = []
    for axis in (0, 1):
        values = np.moveaxis(depth, axis, 0).astype(np.float64)
        before, one, other, after = values[:-3], values[1:-2], values[2:-1], values[3:]
        known = (before > 0.0) & (one > 0.0) & (other > 0.0) & (after > 0.0)
        slant = np.minimum(np.abs(one - before), np.abs(after - other))
        jumps = known & (np.abs(other - one) - 3.0 * slant > _JUMP * np.minimum(one, other))
        along, across = np.nonzero(jumps)
        places = [(along + 2.0) / len(values), (across + 0.5) / values.shape[1]]  # the side between one and other
        found.append(np.stack(places if axis == 1 else places[::-1], -1))
    return np.concatenate(found)


def _contrast(grey: NDArray[np.uint8]) -> Floats:
    """Return the strength of a picture's edges [H, W], with mean 0 and deviation 1; roots limit that of strong ones."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.8)
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    strength = np.sqrt(np.sqrt(x * x + y * y)).astype(np.float64)
    return (strength - strength.mean()) / max(float(strength.std()), 1e-6)


def _coarse(pairs: list[tuple[Floats, Floats]], scale: float) -> tuple[float, float, Shift]:
    """Try all shifts on a grid 160 wide at one scale of ``pairs`` (a frame's edges [N, 2] of depth, and contrast [H,
    W]). Returns the best fit, its scale and its shift."""
    height = max(8, round(_WIDTH * pairs[0][1].shape[0] / pairs[0][1].shape[1]))
    total = np.zeros((height, _WIDTH))
    for edges, picture in pairs:
        small = cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA)
        places = ((edges - 0.5) * scale + 0.5) * (_WIDTH, height)
        columns, rows = np.floor(places).astype(np.int64).T
        inside = (columns >= 0) & (columns < _WIDTH) & (rows >= 0) & (rows < height)
        drawn = np.zeros((height, _WIDTH))
        np.add.at(drawn, (rows[inside], columns[inside]), 1.0)
        total += np.fft.irfft2(np.fft.rfft2(small) * np.conj(np.fft.rfft2(drawn)), (height, _WIDTH)) / len(edges)
    reach = int(_FARTHEST * _WIDTH)
    steps = np.arange(-reach, reach + 1)
    window = total[np.ix_(steps, steps)]  # negative shifts are at the end of each axis
    row, column = np.unravel_index(int(window.argmax()), window.shape)
    return float(window[row, column]) / len(pairs), scale, (float(steps[column]) / _WIDTH, float(steps[row]) / height)


def _refined(pairs: list[tuple[Floats, Floats]], scale: float, shift: Shift) -> tuple[float, Shift]:
    """Search near a scale and shift for the best ones, to a tenth of a pixel of a picture 320 wide. Returns these."""
    best = np.array([scale, *shift])
    for step in (1 / 160, 1 / 320, 1 / 640, 1 / 1280, 1 / 3200):
        moves = [np.array(m) * (2.0 * step, step, step) for m in np.ndindex(3, 3, 3)]
        candidates = [best + move - np.array([2.0 * step, step, step]) for move in moves]
        fits = [float(_fits(pairs, c[0], (c[1], c[2])).mean()) for c in candidates]
        best = candidates[int(np.argmax(fits))]
    return float(best[0]), (float(best[1]), float(best[2]))


def _fits(pairs: list[tuple[Floats, Floats]], scale: float, shift: Shift) -> Floats:
    """Return the mean contrast [pairs] under the edges of each of ``pairs`` (edges, contrast), moved by ``scale`` and
    ``shift``; edges outside count as 0."""
    values = []
    for edges, picture in pairs:
        height, width = picture.shape
        places = (((edges - 0.5) * scale + 0.5 + shift) * (width, height) - 0.5).astype(np.float32)
        under = cv2.remap(
            picture.astype(np.float32), places[None, :, 0], places[None, :, 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=(0.0,),
        )  # fmt: skip
        values.append(float(under.mean()))
    return np.array(values)


def registration_findings(
    examined: Examined, found: Registration | None, calibration: Calibration | None
) -> tuple[list[Finding], Shift]:
    """Return findings about an offset between depth and pictures, and the shift that corrects it: (0, 0) unless depth's
    own geometry, the ``calibration``, agrees."""
    if found is None:
        return [], (0.0, 0.0)
    shift = None if calibration is None else _depth_shift(examined, found, calibration)
    if shift is not None:
        return [_registration_finding(examined, found._replace(scale=1.0, shift=shift), is_depth=True)], shift
    displaced = max(map(abs, found.shift)) >= _MOVED or abs(found.scale - 1.0) >= _SCALED
    if displaced and found.certainty >= _CERTAIN and found.gain >= _GAIN:
        return [_registration_finding(examined, found, is_depth=False)], (0.0, 0.0)
    return [], (0.0, 0.0)


def _depth_shift(examined: Examined, found: Registration, calibration: Calibration) -> Shift | None:
    """Return the shift that depth needs, None unless its geometry and the pictures' edges both say so."""
    if abs(found.scale - 1.0) >= _SCALED or found.certainty < _CORROBORATED:
        return None
    shift = -np.array([calibration.of("x"), calibration.of("y")])  # moving depth is the opposite of moving the centre
    pixel = 1.0 / examined.views.size[0]
    if not any(calibration.is_sure_of(name, float(least)) for name, least in zip("xy", 0.75 * pixel, strict=True)):
        return None
    if np.linalg.norm(np.array(found.shift) - shift) > 0.5 * np.linalg.norm(shift):
        return None
    return float(shift[0]), float(shift[1])


def _registration_finding(examined: Examined, found: Registration, is_depth: bool) -> Finding:
    width, height = examined.scene.frames[0].size
    x, y = found.shift[0] * width, found.shift[1] * height
    rows = range(0, len(examined.looks), max(1, len(examined.looks) // 12))
    edges, row = max(((_depth_edges(examined.looks[row].depth), row) for row in rows), key=lambda each: len(each[0]))
    if is_depth:
        sides = [(abs(x), "to the left" if x > 0.0 else "to the right"), (abs(y), "above" if y > 0.0 else "below")]
        how = " and ".join(f"{pixels:.1f} px {side}" for pixels, side in sides if pixels >= 0.1)
        text, option = f"depth lies {how} of where the colour images show it", f"move it; {FIX}"
    else:
        text = (
            f"depth is not registered to the colour images: its edges fit them scaled by {found.scale:.3f} and moved "
            f"by {x:.1f}, {y:.1f} px; the intrinsics are the depth camera's"
        )
        option = "bring depth to the colour camera with the sensor's calibration, or use its registered images"
    return Finding(
        cause=SHIFT,
        text=f"{text} ({found.certainty:.0f} standard errors, {found.frames} frames)",
        option=option,
        figures={"x_px": x, "y_px": y, "scale": found.scale, "gain": found.gain, "certainty": found.certainty},
        is_mended=is_depth,
        picture=edges_on(examined.photo(row).grey, edges, (edges - 0.5) * found.scale + 0.5 + found.shift),
    )


_SAME_SURFACE = 0.5
_FEWEST_POINTS = 30
_LEAST_CONTRAST = 4.0  # grey levels, as a deviation; a bare wall gives no information
_BETTER = 0.1  # least gain of the mean correlation under another assumption about the pictures
_CERTAIN_GAIN = 5.0  # least gain, in its standard errors among the looks


class Taken(NamedTuple):
    """Which picture a frame's depth is compared with: that of the frame ``lag`` frames later, ``mirrored`` or not."""

    lag: int = 0
    mirrored: bool = False


_OTHERS = (Taken(mirrored=True), *(Taken(lag) for lag in (-2, -1, 1, 2)))


def measure_pictures(examined: Examined, assumed: Assumption) -> tuple[Taken, Gain] | None:
    """Return the change of pictures (`Taken`) with which they agree clearly better, and the gain in the mean
    correlation of greys on surfaces. None if no change helps clearly."""
    views, pairs = examined.views, examined.pairs
    comparison = views.compare(pairs, assumed)
    seen = [agrees > _SAME_SURFACE for agrees in comparison.agrees]
    places = [
        (views.places[one][at], place[at]) for (one, _), at, place in zip(pairs, seen, comparison.place, strict=True)
    ]
    as_they_are = _correlations(examined, places, Taken())
    tried = ((taken, examined.gained(as_they_are, _correlations(examined, places, taken))) for taken in _OTHERS)
    found = [(taken, gain) for taken, gain in tried if gain is not None]
    clear = [each for each in found if each[1].mean > _BETTER and each[1].certainty > _CERTAIN_GAIN]
    return max(clear, key=lambda each: each[1].after, default=None)


def _correlations(examined: Examined, places: list[tuple[Floats, Floats]], taken: Taken) -> Floats:
    """The correlation of greys in pictures ``taken`` so at the ``places`` that each pair of frames sees, float64 [P];
    nan with too few places or too little contrast."""
    found = np.full(len(places), np.nan)
    for row, ((one, other), (mine, theirs)) in enumerate(zip(examined.pairs.tolist(), places, strict=True)):
        first, second = (examined.photos.get(examined.looks[look].number + taken.lag) for look in (one, other))
        if first is None or second is None or len(mine) < _FEWEST_POINTS:
            continue
        if taken.mirrored:
            mine, theirs = (np.stack([1.0 - each[:, 0], each[:, 1]], axis=1) for each in (mine, theirs))
        greys = [values_at(photo.grey, at).astype(np.float64) for photo, at in ((first, mine), (second, theirs))]
        if min(grey.std() for grey in greys) > _LEAST_CONTRAST:
            found[row] = np.corrcoef(greys[0], greys[1])[0, 1]
    return found


def picture_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Return findings about pictures that belong to other frames or are mirrored, though depth and poses are not."""
    found = measure_pictures(examined, assumed)
    if found is None:
        return []
    (taken, fit), row = found, len(examined.looks) // 2
    if taken.mirrored:
        what = "left and right are swapped in the pictures, but not in depth and poses"
        cause, option = "mirrored colour", "mirror the colour images"
    else:
        way, frames = "earlier" if taken.lag > 0 else "later", plural(abs(taken.lag), "frame")
        what = f"pictures are those of other frames: each belongs to the frame {frames} {way}"
        cause, option = "colour of other frames", "give the pictures the names of the frames that they belong to"
    photo, look = examined.photo(row), examined.looks[row]
    depth = np.clip(255.0 * look.depth / max(float(np.quantile(look.depth, 0.98)), 1e-6), 0, 255).astype(np.uint8)
    finding = Finding(
        cause=cause,
        text=f"{what}: where two views see the same surface, their greys correlate by {fit.before:.2f}, "
        f"with this corrected by {fit.after:.2f} ({fit.certainty:.0f} standard errors)",
        option=option,
        figures={"correlation": fit.before, "correlation_then": fit.after, "certainty": fit.certainty},
        picture=side_by_side([(photo.name, photo.grey), ("its depth", depth)]),
        stops=True,
    )
    return [finding]
