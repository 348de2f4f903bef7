"""Draw a frame's depth and masks as pictures to look at. It uses only numpy, as Blender draws them, too."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..posed.classes import VOID, ClassTable
from .frame import PanopticMask

_GRADIENT = np.array(
    [[255, 240, 190], [250, 170, 70], [220, 80, 90], [130, 40, 140], [45, 25, 110], [12, 10, 40]], np.float64
)
"""sRGB from near to far, each darker than the one before, so that depth stays readable in greyscale."""
_LINE, _BORDER = 0.45, 0.4  # brightness of lines at whole metres and of segment borders, relative to the pixel
_MOST_LINES = 40  # maximum number of lines in a picture; deeper scenes get none
_NONE = (60, 60, 60)  # sRGB of pixels without depth or without a class


class DepthColours(NamedTuple):
    """A picture of depth: ``rgb`` uint8 [H, W, 3], light at ``near`` and dark at ``far`` (metres, both 0 without any
    depth). A line marks each whole metre."""

    rgb: NDArray[np.uint8]
    near: float
    far: float


def depth_colours(depth: NDArray[np.float32]) -> DepthColours:
    """Draw depth, float32 [H, W] in metres with 0 = none."""
    has = depth > 0.0
    rgb = np.full((*depth.shape, 3), _NONE, np.float64)
    if not has.any():
        return DepthColours(rgb.astype(np.uint8), 0.0, 0.0)
    near, far = (float(value) for value in np.percentile(depth[has], [0.5, 99.5]))
    share = np.clip((depth[has] - near) / max(far - near, 1e-6), 0.0, 1.0)
    steps = np.linspace(0.0, 1.0, len(_GRADIENT))
    rgb[has] = np.stack([np.interp(share, steps, _GRADIENT[:, channel]) for channel in range(3)], axis=-1)
    if far - near < _MOST_LINES:
        rgb[borders(np.floor(depth).astype(np.int64)) & has] *= _LINE
    return DepthColours(np.rint(rgb).astype(np.uint8), near, far)


def mask_colours(mask: PanopticMask, classes: ClassTable) -> NDArray[np.uint8]:
    """Draw a mask in its classes' colours with dark borders between segments, uint8 [H, W, 3]."""
    palette = np.full((max(classes.ids, default=0) + 1, 3), _NONE, np.float64)
    for category in classes.categories:
        palette[category.id] = category.colour
    class_map = mask.class_map()
    rgb = palette[np.where(class_map < len(palette), class_map, VOID)]
    rgb[borders(mask.ids.astype(np.int64))] *= _BORDER
    return np.rint(rgb).astype(np.uint8)


def borders(values: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return the pixels whose right or lower neighbour has a different value, bool [H, W]."""
    found = np.zeros(values.shape, np.bool_)
    found[:, :-1] |= values[:, 1:] != values[:, :-1]
    found[:-1] |= values[1:] != values[:-1]
    return found
