"""Do the pictures show the surfaces that depth and poses describe? A surface has the same grey in two pictures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .findings import Finding
from .looks import Floats, Photo, values_at
from .pictures import side_by_side
from .reprojection import Assumption, Examined

_SAME_SURFACE = 0.5
_FEWEST_POINTS, _FEWEST_PAIRS, _FEWEST_LOOKS = 30, 12, 6
_LEAST_CONTRAST = 4.0
"""Grey levels, as a deviation. A bare wall tells nothing."""
_BETTER = 0.1
"""Least gain of the mean correlation under another assumption about the pictures."""
_CERTAIN = 5.0
"""Least gain, in its standard errors among the looks."""


class Taken(NamedTuple):
    """Which picture is used for a look: that of the frame so many places later (``lag``), ``mirrored`` or not."""

    lag: int = 0
    mirrored: bool = False


_OTHERS = (Taken(mirrored=True), *(Taken(lag) for lag in (-2, -1, 1, 2)))


class PictureFit(NamedTuple):
    """How well pictures agree on surfaces, as a mean correlation of greys: as they are, and ``taken`` otherwise."""

    taken: Taken
    before: float
    after: float
    certainty: float


def measure_pictures(examined: Examined, assumed: Assumption) -> PictureFit | None:
    """What makes the pictures agree clearly better than they do as they are. None where nothing does."""
    views, pairs = examined.views, examined.pairs
    comparison = views.compare(pairs, assumed)
    seen = [agrees > _SAME_SURFACE for agrees in comparison.agrees]
    places = [
        (views.places[one][at], place[at]) for (one, _), at, place in zip(pairs, seen, comparison.place, strict=True)
    ]
    as_they_are = _correlations(examined, places, Taken())
    best = None
    for taken in _OTHERS:
        gains = _correlations(examined, places, taken) - as_they_are
        by_look = _by_look(gains, pairs, len(views.looks))
        known = np.isfinite(gains)
        if known.sum() < _FEWEST_PAIRS or len(by_look) < _FEWEST_LOOKS:
            continue
        gain, error = float(by_look.mean()), float(by_look.std(ddof=1)) / np.sqrt(len(by_look))
        before = float(as_they_are[known].mean())
        fit = PictureFit(taken, before, before + float(gains[known].mean()), gain / max(error, 1e-9))
        is_clear = gain > _BETTER and fit.certainty > _CERTAIN
        if is_clear and (best is None or fit.after > best.after):
            best = fit
    return best


def _correlations(examined: Examined, places: list[tuple[Floats, Floats]], taken: Taken) -> Floats:
    """The correlation of greys where each pair sees the same surface, float64 [P]; nan where there is too little."""
    found = np.full(len(places), np.nan)
    for row, ((one, other), (mine, theirs)) in enumerate(zip(examined.pairs.tolist(), places, strict=True)):
        first, second = (_photo(examined, look, taken) for look in (one, other))
        if first is None or second is None or len(mine) < _FEWEST_POINTS:
            continue
        greys = [
            values_at(photo.grey, _mirrored(at) if taken.mirrored else at).astype(np.float64)
            for photo, at in ((first, mine), (second, theirs))
        ]
        if min(grey.std() for grey in greys) > _LEAST_CONTRAST:
            found[row] = np.corrcoef(greys[0], greys[1])[0, 1]
    return found


def _photo(examined: Examined, look: int, taken: Taken) -> Photo | None:
    """The picture used for a look, where it is loaded."""
    return examined.photos.get(examined.looks[look].number + taken.lag)


def _mirrored(places: Floats) -> Floats:
    return np.stack([1.0 - places[:, 0], places[:, 1]], axis=1)


def _by_look(gains: Floats, pairs: NDArray[np.int64], looks: int) -> Floats:
    """The mean gain of each look that has one, so that looks in many pairs count once."""
    total, count = np.zeros(looks), np.zeros(looks)
    known = np.isfinite(gains)
    for column in (0, 1):
        np.add.at(total, pairs[known, column], gains[known])
        np.add.at(count, pairs[known, column], 1.0)
    return total[count > 0] / count[count > 0]


def picture_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Pictures that belong to other frames, or are mirrored, where depth and poses are not."""
    fit = measure_pictures(examined, assumed)
    if fit is None:
        return []
    cause, what, option = _words(fit.taken)
    row = len(examined.looks) // 2
    photo, look = examined.photo(row), examined.looks[row]
    depth = np.clip(255.0 * look.depth / max(float(np.quantile(look.depth, 0.98)), 1e-6), 0, 255).astype(np.uint8)
    return [
        Finding(
            cause=cause,
            severity="wrong",
            text=f"{what}: where two views see the same surface, their greys correlate by {fit.before:.2f}, and then "
            f"by {fit.after:.2f} ({fit.certainty:.0f} standard errors)",
            option=option,
            figures={"correlation": fit.before, "correlation_then": fit.after, "certainty": fit.certainty},
            picture=side_by_side([(photo.name, photo.grey), ("its depth", depth)]),
        )
    ]


def _words(taken: Taken) -> tuple[str, str, str]:
    if taken.mirrored:
        what = "left and right are swapped in the pictures, but not in depth and poses"
        return "mirrored colour", what, "mirror the colour images"
    way = "earlier" if taken.lag > 0 else "later"
    places = "1 frame" if abs(taken.lag) == 1 else f"{abs(taken.lag)} frames"
    what = f"pictures are those of other frames: each belongs to the frame {places} {way}"
    return "colour of other frames", what, "give the pictures the names of the frames that they belong to"
