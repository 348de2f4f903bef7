"""From the engine's sRGB bytes to the linear colours Blender stores."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

UNKNOWN = (96, 96, 96)
"""sRGB colour of points without a class."""

_BYTES = np.arange(256) / 255.0
_LINEAR = np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_rgba(srgb: ArrayLike) -> NDArray[np.float32]:
    """sRGB bytes 0..255 [..., 3] as linear colours with alpha 1, float32 [..., 4] (IEC 61966-2-1)."""
    value = np.asarray(srgb)
    rgba = np.ones((*value.shape[:-1], 4), np.float32)
    rgba[..., :3] = _LINEAR[value]
    return rgba


def object_colour(srgb: Sequence[int]) -> tuple[float, float, float, float]:
    """One sRGB colour as an object's viewport colour, linear RGBA."""
    red, green, blue, alpha = linear_rgba(srgb).tolist()
    return red, green, blue, alpha
