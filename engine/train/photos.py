"""Compares the photos of a capture: the exposure and the sharpness of each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import photo_detail
from ..scene.exposure import LARGEST_GAIN, is_exposed

OUTLIER = 0.4
"""Difference of log colours above which a pixel shows a highlight, or something other than its point."""
NEIGHBOURS = 4
"""The number of photos on either side, of a similar view, with which a photo's sharpness is compared."""
LEAST_WEIGHT = 0.1


def exposure_gains(
    photos: Sequence[NDArray[np.uint8]], point_of_pixel: Sequence[NDArray[np.int32]], points: int
) -> NDArray[np.float64]:
    """Return how bright each photo shows the room compared with the mean photo, by channel: float64 [N, 3], with a
    geometric mean of 1. ``photos`` uint8 [H, W, 3]; ``point_of_pixel`` int32 [H, W] each: the point, of ``points`` in
    the cloud, that each pixel shows, -1 = none.

    Auto exposure and white balance multiply light, which nearly multiplies encoded values, too. So the logarithm of a
    pixel is modelled as its photo's gain plus its point's colour, and least squares separate the two over all pixels,
    then once more without outliers. Photos are read one at a time, and only sums are kept."""
    fit: _Fit | None = None
    for _ in range(2):
        fit = _least_squares(*_log_colour_sums(photos, point_of_pixel, points, fit))
    assert fit is not None
    return np.exp(np.clip(fit.gains, -np.log(LARGEST_GAIN), np.log(LARGEST_GAIN)))


class _Fit(NamedTuple):
    """The result of least squares: photos' log gains [photos, 3], of mean 0, and points' log colours [points, 3]."""

    gains: NDArray[np.float64]
    colours: NDArray[np.float64]


def _least_squares(seen: Any, by_point: NDArray[np.float64], by_photo: NDArray[np.float64]) -> _Fit:
    """Return the least-squares fit, given what `_log_colour_sums` returns. Eliminates the points first."""
    from scipy import sparse

    pixels = np.maximum(np.asarray(seen.sum(0)).reshape(-1), 1)
    mean = by_point / pixels[:, None]
    system = np.diag(np.asarray(seen.sum(1)).reshape(-1)) - (seen @ sparse.diags(1 / pixels) @ seen.T).toarray()
    # A photo that shares no point with another has no gain: the smallest solution leaves it at 0.
    gains = np.linalg.lstsq(system, by_photo - seen @ mean, rcond=1e-6)[0]
    gains -= gains.mean(axis=0)  # pixels determine only the differences of gains
    return _Fit(gains, mean - (seen.T @ gains) / pixels[:, None])


def _log_colour_sums(
    photos: Sequence[NDArray[np.uint8]], point_of_pixel: Sequence[NDArray[np.int32]], points: int, fit: _Fit | None
) -> tuple[Any, NDArray[np.float64], NDArray[np.float64]]:
    """Return how many pixels of each photo show each point, sparse float64 [photos, points], and the sums of their log
    colours by point, float64 [points, 3], and by photo [photos, 3]. Leaves out pixels that are very dark or bright or,
    with a ``fit``, that differ much from it."""
    from scipy import sparse

    by_point, by_photo = np.zeros((3, points)), np.zeros((len(photos), 3))
    shown: list[NDArray[np.int64]] = []
    counts: list[NDArray[np.int64]] = []
    for number, (photo, point) in enumerate(zip(photos, point_of_pixel, strict=True)):
        usable = (point >= 0) & is_exposed(photo)
        colour, rows = np.log(photo[usable].astype(np.float64)), point[usable].astype(np.int64)
        if fit is not None:
            fits = (np.abs(colour - fit.gains[number] - fit.colours[rows]) < OUTLIER).all(axis=1)
            colour, rows = colour[fits], rows[fits]
        for channel in range(3):
            np.add.at(by_point[channel], rows, colour[:, channel])
        by_photo[number] = colour.sum(axis=0)
        unique, count = np.unique(rows, return_counts=True)
        shown.append(unique)
        counts.append(count)
    ends = np.cumsum([0, *map(len, shown)])
    pixels = (np.concatenate(counts).astype(np.float64), np.concatenate(shown), ends)
    return sparse.csr_matrix(pixels, (len(photos), points)), by_point.T.copy(), by_photo


def sharpness_weights(photos: Iterable[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """Return the weight of each photo in the picture loss, float64 [N] in (0, 1]; ``photos`` uint8 [H, W, 3] in
    recording order. A photo blurred by motion has less detail than its neighbours, which show nearly the same."""
    details = np.array([photo_detail(photo) for photo in photos])
    weights = np.ones(len(details))
    for index, own in enumerate(details):
        around = details[max(index - NEIGHBOURS, 0) : index + NEIGHBOURS + 1]
        weights[index] = np.clip((own / max(float(np.median(around)), 1e-9)) ** 2, LEAST_WEIGHT, 1.0)
    return weights
