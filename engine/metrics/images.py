"""Scores rendered pictures against photos (PSNR, SSIM), and rendered depth against the sensor's."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene.view import border_mask

BEST_PSNR = 100.0
"""Decibels of identical pictures: finite, so that means and JSON files stay finite."""

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


class PictureScores(NamedTuple):
    """PSNR in decibels and SSIM of one view; names with ``_fitted``: after the colours were fitted (`fit_colours`)."""

    psnr: float
    ssim: float
    psnr_fitted: float


def score_picture(rendered: NDArray[np.generic], photo: NDArray[np.uint8]) -> PictureScores:
    """Score a picture [H, W, 3], uint8 or floats in [0, 1], against the frame's photo uint8 [H, W, 3]. The fitted
    scores leave out what a gain and an offset explain, since a camera with auto exposure shows one surface in many
    colours. Black borders of undistortion count neither in the fit nor in PSNR; SSIM uses the whole picture. Raises
    ValueError if shapes differ."""
    valid, (x, y) = ~border_mask(photo), _unit(rendered, photo)
    return PictureScores(psnr(x, y, valid), ssim(x, y), psnr(fit_colours(x, y, valid), y, valid))


def fit_colours(
    rendered: NDArray[np.generic], photo: NDArray[np.generic], valid: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return ``rendered`` with the gain and offset per channel that bring it closest to ``photo``, by least squares
    over ``valid`` pixels, bool [H, W]. Pictures [H, W, 3], uint8 or floats in [0, 1]; the result is float64, clipped to
    [0, 1], so its PSNR is never lower. Raises ValueError if shapes differ."""
    x, y = _unit(rendered, photo)
    here, there = (each.reshape(-1, 3) if valid.all() else each[valid] for each in (x, y))
    mean_here, mean_there = here.mean(axis=0), there.mean(axis=0)
    away = here - mean_here
    variance = np.diag(away.T @ away) / len(away)
    covariance = np.diag(away.T @ (there - mean_there)) / len(away)
    gain = np.divide(covariance, variance, out=np.zeros(3), where=variance > 0)  # a flat picture has none
    fitted = x * gain
    fitted += mean_there - mean_here * gain
    return np.clip(fitted, 0.0, 1.0, out=fitted)


def psnr(a: NDArray[np.generic], b: NDArray[np.generic], valid: NDArray[np.bool_] | None = None) -> float:
    """Return -10 log10(MSE), decibels, of two pictures [H, W, 3], uint8 or floats in [0, 1], over all pixels or those
    ``valid``, bool [H, W]. Raises ValueError if shapes differ."""
    x, y = _unit(a, b)
    gap = (x - y).ravel() if valid is None or valid.all() else (x - y)[valid].ravel()
    error = float(gap @ gap) / len(gap)
    return BEST_PSNR if error < 10 ** (-BEST_PSNR / 10) else -10.0 * math.log10(error)


def ssim(a: NDArray[np.generic], b: NDArray[np.generic]) -> float:
    """Return the mean structural similarity of two pictures [H, W, 3], uint8 or floats in [0, 1]; 1 = identical. As in
    the training loss: 11x11 Gaussian window with sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2, channels
    separately. Raises ValueError if shapes differ."""
    x, y = _unit(a, b)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    shared, square_x, square_y = mean_x * mean_y, mean_x * mean_x, mean_y * mean_y
    covariance = _window_mean(x * y) - shared
    variances = (_window_mean(x * x) - square_x) + (_window_mean(y * y) - square_y)
    alike = (2 * covariance + C2) * (2 * shared + C1)
    return float(np.mean(alike / ((variances + C2) * (square_x + square_y + C1))))


def _unit(*pictures: NDArray[np.generic]) -> list[NDArray[np.float64]]:
    """Convert pictures to float64 in [0, 1]. Raises ValueError if their shapes differ."""
    if len({picture.shape for picture in pictures}) > 1:
        raise ValueError(f"pictures differ in shape: {' and '.join(str(each.shape) for each in pictures)}")
    return [
        each.astype(np.float64) / 255.0 if each.dtype == np.uint8 else np.clip(each, 0.0, 1.0, dtype=np.float64)
        for each in pictures
    ]


def _window_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    import cv2

    return np.asarray(cv2.GaussianBlur(values, (WINDOW, WINDOW), SIGMA, borderType=cv2.BORDER_CONSTANT), np.float64)


LEAST_ALPHA = 0.5
"""Least alpha of a pixel that counts. Below it the model draws a hole, which has no depth."""
BIN, BINS = 1e-4, 100_000
"""The width in metres of the error bins, and their number. Errors above 10 m go into the last bin."""


class DepthErrors:
    """Collects the absolute depth errors of all views' pixels, in bins, so that memory does not grow with the views.
    The median is over all pixels, not the mean of the views' medians, since a view with little depth tells little."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS, np.int64)

    def add(self, rendered: NDArray[np.float32], alpha: NDArray[np.float32], measured: NDArray[np.float32]) -> None:
        """Count a view's pixels: rendered depth, planar metres; coverage ``alpha`` in [0, 1]; ``measured`` depth,
        planar metres, 0 = none; [H, W] each. Raises ValueError if shapes differ."""
        if not rendered.shape == alpha.shape == measured.shape:
            raise ValueError(f"depths differ in shape: {rendered.shape}, {alpha.shape} and {measured.shape}")
        counted = (measured > 0) & (alpha >= LEAST_ALPHA)
        errors = np.abs(rendered[counted].astype(np.float64) - measured[counted])
        self._counts += np.bincount(np.minimum(errors / BIN, BINS - 1).astype(np.int64), minlength=BINS)

    @property
    def median(self) -> float | None:
        """The median error in metres, to the width of a bin; None if no pixel was counted."""
        below = np.cumsum(self._counts)
        if not below[-1]:
            return None
        middle = int(np.searchsorted(below, below[-1] / 2))
        return round((middle + 0.5) * BIN, 5)
