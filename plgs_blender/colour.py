"""From the engine's sRGB bytes to the linear colours Blender stores."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

UNKNOWN = (96, 96, 96)
"""sRGB colour of points without a class."""


def linear_rgba(srgb: ArrayLike) -> NDArray[np.float32]:
    """sRGB bytes 0..255 [..., 3] as linear colours with alpha 1, float32 [..., 4] (IEC 61966-2-1)."""
    value = np.asarray(srgb, np.float32) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.concatenate([linear, np.ones_like(linear[..., :1])], axis=-1).astype(np.float32)


def object_colour(srgb: Sequence[int]) -> tuple[float, float, float, float]:
    """One sRGB colour as an object's viewport colour, linear RGBA."""
    red, green, blue, alpha = linear_rgba(srgb).tolist()
    return red, green, blue, alpha
