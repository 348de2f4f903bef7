"""What is particular to a photo and not to the room: its exposure and its sharpness."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

LARGEST_GAIN = 4.0
"""Of a photo against the room, and its inverse the least."""
DARK, BRIGHT = 12, 243
"""Values of 255 outside which a photo says little of its exposure."""
OUTLIER = 0.4
"""Of log colours: a pixel further off than this shows something else than its point, or a highlight."""
NEIGHBOURS = 4
"""Photos on either side that a photo's sharpness is compared with: they show about the same."""
LEAST_WEIGHT = 0.1


def exposure_gains(
    photos: Sequence[NDArray[np.uint8]], point_of_pixel: Sequence[NDArray[np.int32]], points: int
) -> NDArray[np.float64]:
    """How much brighter each photo shows the room than the photos do on the average, by channel: float64 [N, 3].

    ``photos`` uint8 [H, W, 3]; ``point_of_pixel`` int32 [H, W] a photo: the point of the cloud (of ``points`` points)
    that each pixel shows, -1 = none. Auto exposure and white balance multiply light, which is nearly a gain of encoded
    values too: the logarithm of a pixel is its photo's gain plus its point's colour, which least squares tell apart
    over all pixels, twice, the second time without those that do not fit. The gains' geometric mean is 1.
    """
    rows, photo, colour = _log_colours(photos, point_of_pixel)
    gains = np.zeros((len(photos), 3))
    fits = np.ones(len(rows), bool)
    for _ in range(2):
        gains, points_colour = _least_squares(rows[fits], photo[fits], colour[fits], len(photos), points)
        fits = (np.abs(colour - gains[photo] - points_colour[rows]) < OUTLIER).all(axis=1)
    return np.exp(np.clip(gains, -np.log(LARGEST_GAIN), np.log(LARGEST_GAIN)))


def _least_squares(
    rows: NDArray[np.int64], photo: NDArray[np.int64], colour: NDArray[np.float64], photos: int, points: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log gains [photos, 3] of mean 0 and log colours [points, 3] whose sums are nearest to ``colour`` [n, 3], the log
    colour that photo ``photo[i]`` gives point ``rows[i]``. The points are eliminated first."""
    from scipy import sparse

    seen = sparse.csr_matrix((np.ones(len(rows)), (photo, rows)), (photos, points))
    pixels = np.maximum(np.asarray(seen.sum(0)).reshape(-1), 1)
    mean = np.column_stack([np.bincount(rows, colour[:, c], points) for c in range(3)]) / pixels[:, None]
    total = np.column_stack([np.bincount(photo, colour[:, c], photos) for c in range(3)])
    system = np.diag(np.asarray(seen.sum(1)).reshape(-1)) - (seen @ sparse.diags(1 / pixels) @ seen.T).toarray()
    # A photo that shares no point with another has no gain: the least solution leaves it at 0.
    gains = np.linalg.lstsq(system, total - seen @ mean, rcond=1e-6)[0]
    gains -= gains.mean(axis=0)
    shift = np.column_stack([np.bincount(rows, gains[photo, c], points) for c in range(3)]) / pixels[:, None]
    return gains, mean - shift


def _log_colours(
    photos: Sequence[NDArray[np.uint8]], point_of_pixel: Sequence[NDArray[np.int32]]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Of all pixels neither too dark nor too bright: point int64 [n], photo int64 [n] and log colour [n, 3]."""
    parts = []
    for number, (photo, rows) in enumerate(zip(photos, point_of_pixel, strict=True)):
        usable = (rows >= 0) & (photo.min(axis=2) >= DARK) & (photo.max(axis=2) <= BRIGHT)
        colour = np.log(photo[usable].astype(np.float64))
        parts.append((rows[usable].astype(np.int64), np.full(len(colour), number), colour))
    rows, photo, colour = (np.concatenate(column) for column in zip(*parts, strict=True))
    return rows, photo, colour


def sharpness_weights(photos: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """How much each photo uint8 [H, W, 3], in recording order, counts for the picture: float64 [N] in (0, 1].

    A photo blurred by motion has less detail than its neighbours, which show about the same. Detail is the mean
    absolute Laplacian over the mean brightness, so that exposure does not matter.
    """
    detail = np.array([_detail(photo) for photo in photos])
    weights = np.ones(len(photos))
    for index, own in enumerate(detail):
        around = detail[max(index - NEIGHBOURS, 0) : index + NEIGHBOURS + 1]
        weights[index] = np.clip((own / max(float(np.median(around)), 1e-9)) ** 2, LEAST_WEIGHT, 1.0)
    return weights


def _detail(photo: NDArray[np.uint8]) -> float:
    grey = photo.mean(axis=2, dtype=np.float32)
    return float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean() / (grey.mean() + 1.0))
