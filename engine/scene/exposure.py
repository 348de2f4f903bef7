"""Compare the brightness of a photo with that of other pictures of the same room."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LARGEST_GAIN = 4.0
"""Limit of a photo's exposure relative to the room's, as a factor or its inverse."""
DARK, BRIGHT = 12, 243
"""Values (of 255) outside which a pixel says little about its photo's exposure: 5 % from either end."""
LEAST_COMPARED = 100
"""The least number of pixels that tell a photo's exposure."""


def is_exposed(colour: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which colours [..., 3] of 0 to 255 are neither too dark nor too bright for judging exposure, bool [...]."""
    return np.asarray((colour.min(axis=-1) >= DARK) & (colour.max(axis=-1) <= BRIGHT))


def exposure_beside(photo: NDArray[np.generic], drawn: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return how much brighter a photo is than another picture of the same places, both as colours [N, 3] of 0 to 255:
    a factor for each channel, float64 [3]; 1 if too few pixels can tell."""
    usable = is_exposed(photo) & is_exposed(drawn)
    if usable.sum() < LEAST_COMPARED:
        return np.ones(3)
    ratio = np.exp(np.median(np.log(photo[usable] / drawn[usable].astype(np.float64)), axis=0))
    return np.asarray(ratio.clip(1 / LARGEST_GAIN, LARGEST_GAIN))
