"""Findings on photos: blur, exposure, and pixels that are black or white."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..posed.layout import listed
from .findings import Finding
from .looks import Floats, Photo, values_at
from .pictures import side_by_side
from .reprojection import Assumption, Examined

_NEIGHBOURS = 4
"""The number of photos before it, and after it, that a photo is compared with."""
_BLURRED, _BLURRED_SURFACE = 0.8, 0.88
"""Shares of the neighbours' detail, in the whole picture and on the same surfaces. Turning away costs a tenth."""
_VERY_BLURRED, _BLURRED_BY_ITSELF = 0.35, 0.3
_EXPOSURE = 1.5
"""Factor between bright and dark frames of one surface, from the 5th to the 95th percentile."""
_CLIPPED = 0.5
_SAME_DISTANCE = 0.15
"""Largest logarithm of the ratio of two distances. A nearer surface looks smoother, which is not blur."""
_GRAIN = 9
"""Pixels of a picture 320 wide over which detail is averaged."""
_NO_DETAIL, _DETAIL = 13.0, 1500.0
_LEAST_FRAMES = 5
_FEWEST_POINTS = 100
_SURFACES_AGREE = 0.5


def clipped_findings(photos: dict[int, Photo]) -> list[Finding]:
    """Frames that are mostly black or white."""
    clipped = [shot for shot in photos.values() if shot.clipped > _CLIPPED]
    if not clipped:
        return []
    names = tuple(shot.name for shot in clipped)
    return [
        Finding(
            cause="exposure",
            severity="note",
            text=f"in {len(clipped)} of {len(photos)} frames most pixels are black or white: {listed(names)}",
            option="leave them out with a splits.json",
            figures={"frames": float(len(clipped)), "clipped": max(shot.clipped for shot in clipped)},
            frames=names,
            leave_out=names,
            picture=side_by_side([(shot.name, shot.grey) for shot in clipped[:2]]),
        )
    ]


def blur_findings(photos: dict[int, Photo]) -> list[Finding]:
    """Frames with far less detail than their neighbours. For scenes without depth."""
    shots = list(photos.values())
    return _blur_findings(shots, np.ones(len(shots), bool), _BLURRED_BY_ITSELF)


def blur_findings_on_surfaces(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Frames with less detail than their neighbours, also on the surfaces that both show. A bare wall is not blur."""
    shots = [examined.photo(row) for row in range(len(examined.looks))]
    details = _relative_details(examined, assumed)
    if details is None:
        return []
    beside = np.exp(details - _neighbour_medians(details))
    return _blur_findings(shots, beside < _BLURRED_SURFACE, _BLURRED)


def _blur_findings(shots: Sequence[Photo], may_be: NDArray[np.bool_], threshold: float) -> list[Finding]:
    detail = np.array([shot.detail for shot in shots])
    sharpness = detail / np.maximum(_neighbour_medians(detail), 1e-6)
    found = sorted((float(sharpness[row]), int(row)) for row in np.flatnonzero(may_be & (sharpness < threshold)))
    if not found or len(shots) < _LEAST_FRAMES:
        return []
    names = tuple(shots[row].name for _, row in found)
    worst, row = found[0]
    beside = shots[row - 1] if row else shots[1]
    drop = tuple(shots[row].name for value, row in found if value < _VERY_BLURRED)
    more = f"; {listed(drop)} could also be left out" if drop else ""
    worst_too = "; leave the worst out with a splits.json" if drop else ""
    return [
        Finding(
            cause="blur",
            severity="note",
            text=f"less sharp than those around them: {len(found)} of {len(shots)} frames, the worst with {worst:.0%} "
            f"of the detail: {listed(names)}{more}",
            option=f"no change is needed, as a lift gives them less weight{worst_too}",
            figures={"frames": float(len(found)), "least_detail": worst},
            frames=names,
            leave_out=drop,
            picture=side_by_side([(beside.name, beside.grey), (shots[row].name, shots[row].grey)]),
        )
    ]


def _neighbour_medians(values: Floats) -> Floats:
    """The median of the four values before and the four after each one, float64 [N] in recording order."""
    if len(values) < 2:
        return values
    return np.array(
        [
            np.median(np.concatenate([values[max(0, i - _NEIGHBOURS) : i], values[i + 1 : i + 1 + _NEIGHBOURS]]))
            for i in range(len(values))
        ]
    )


def exposure_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """How much brighter some frames show a surface than others do."""
    greys = [examined.photo(row).grey for row in range(len(examined.looks))]
    gains = _relative_levels(examined, assumed, greys)
    if gains is None:
        return []
    low, high = np.quantile(gains, [0.05, 0.95])
    spread = float(np.exp(high - low))
    if spread < _EXPOSURE:
        return []
    dark, bright = int(np.argmin(gains)), int(np.argmax(gains))
    return [
        Finding(
            cause="exposure",
            severity="note",
            text=f"exposure varies: some frames show the same surface {spread:.1f} times as bright as others "
            f"(darkest {examined.name(dark)}, brightest {examined.name(bright)})",
            option="no change is needed, as a lift fits each frame's exposure; lock it when you record again",
            figures={"times": spread},
            picture=side_by_side([(examined.name(row), greys[row]) for row in (dark, bright)]),
        )
    ]


def _relative_details(examined: Examined, assumed: Assumption) -> Floats | None:
    """The logarithm of each look's detail on surfaces, relative to the others there, float64 [F] with median 0."""
    import cv2

    maps = []
    for row in range(len(examined.looks)):
        grey = examined.photo(row).grey
        detail = cv2.blur(np.abs(cv2.Laplacian(grey, cv2.CV_32F)), (_GRAIN, _GRAIN))
        brightness = cv2.blur(grey.astype(np.float32), (_GRAIN, _GRAIN))
        # Exposure multiplies both. Dark pixels have little detail besides noise.
        maps.append(_NO_DETAIL + _DETAIL * detail / np.maximum(brightness, 1.0))
    levels = _relative_levels(examined, assumed, maps, _SAME_DISTANCE)
    return None if levels is None else levels - np.median(levels)


def _relative_levels(
    examined: Examined, assumed: Assumption, maps: Sequence[NDArray[Any]], nearly: float = np.inf
) -> Floats | None:
    """The logarithm of each look's values on surfaces, relative to the others there, float64 [F] with mean 0.

    This is a least-squares fit to the median ratios of the pairs; None where too few pairs see the same surface. Values
    of 12 to 243 count, on surfaces whose distances to both cameras differ by at most ``nearly`` (logarithm).
    """
    comparison = examined.views.compare(examined.pairs, assumed)
    rows, ratios = [], []
    for row, (one, other) in enumerate(examined.pairs.tolist()):
        same = comparison.agrees[row] > _SURFACES_AGREE
        same[same] &= np.abs(np.log(comparison.scale[row][same])) < nearly
        if same.sum() < _FEWEST_POINTS / 2:
            continue
        ours = values_at(maps[one], examined.views.places[one][same]).astype(np.float64)
        theirs = values_at(maps[other], comparison.place[row][same]).astype(np.float64)
        fair = (ours > 12) & (ours < 243) & (theirs > 12) & (theirs < 243)
        if fair.sum() >= _FEWEST_POINTS / 4:
            rows.append((one, other))
            ratios.append(float(np.median(np.log(theirs[fair] / ours[fair]))))
    if len(rows) < len(examined.looks):
        return None
    system = np.zeros((len(rows), len(examined.looks)))
    system[np.arange(len(rows)), [one for one, _ in rows]] = -1.0
    system[np.arange(len(rows)), [other for _, other in rows]] = 1.0
    levels = np.linalg.lstsq(system, np.array(ratios), rcond=1e-6)[0]
    return levels - levels.mean()
