"""How close the rendered depth is to what the sensor measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_ALPHA = 0.5
"""Alpha from which a pixel counts. Below it the model draws a hole, which has no depth."""
CLOSE = 0.05
"""Metres within which a rendered depth is right."""
BIN, BINS = 1e-4, 100_000
"""The width in metres of the bins for counting errors, and their number. Errors above 10 m go into the last bin."""


class DepthErrors:
    """Absolute errors of all pixels of all views, counted in bins, so that a thousand views need no more memory than
    one.

    The median is that of all pixels, not the mean of the views' medians, as a view with little depth tells little.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(BINS, np.int64)
        self._pixels = self._close = 0

    def add(self, rendered: NDArray[np.float32], alpha: NDArray[np.float32], measured: NDArray[np.float32]) -> None:
        """Count a view. All [H, W]: planar metres, coverage in [0, 1], planar metres (0 = none). Raises ValueError if
        shapes differ.
        """
        if not rendered.shape == alpha.shape == measured.shape:
            raise ValueError(f"depths differ in shape: {rendered.shape}, {alpha.shape} and {measured.shape}")
        counted = (measured > 0) & (alpha >= LEAST_ALPHA)
        errors = np.abs(rendered[counted].astype(np.float64) - measured[counted])
        self._counts += np.bincount(np.minimum(errors / BIN, BINS - 1).astype(np.int64), minlength=BINS)
        self._pixels += errors.size
        self._close += int(np.count_nonzero(errors <= CLOSE))

    @property
    def median(self) -> float | None:
        """The median in metres, to the width of a bin; None if no pixel was counted."""
        if not self._pixels:
            return None
        middle = int(np.searchsorted(np.cumsum(self._counts), self._pixels / 2))
        return round((middle + 0.5) * BIN, 5)

    @property
    def close_share(self) -> float | None:
        """The share of pixels, in [0, 1], with an error within CLOSE; None if no pixel was counted."""
        return self._close / self._pixels if self._pixels else None
