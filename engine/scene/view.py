"""A frame's pixels, all brought to one size: what the lift works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .borders import border_mask
from .camera import Camera
from .frame import Frame, PanopticMask, Size
from .pixels import resize_colour, resize_nearest


@dataclass(frozen=True, eq=False)
class View:
    """Colour uint8 [H, W, 3], depth float32 [H, W] metres (0 = none) and mask of a frame at the size of ``camera``.

    ``border`` bool [H, W]: where the picture shows nothing but a black border; None where it has none.
    """

    name: str
    camera: Camera
    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: PanopticMask
    border: NDArray[np.bool_] | None = None


def load_view(frame: Frame, size: Size | None = None) -> View:
    """Read a frame at ``size`` (width, height), or at its own size. Raises SceneError when a file is bad, or when
    the frame has no depth or no mask.
    """
    width, height = size or frame.size
    colour = frame.read_colour(None)
    border = border_mask(colour)
    return View(
        name=frame.name,
        camera=frame.camera.resized(width, height),
        colour=resize_colour(colour, (width, height)),
        depth=frame.depth((width, height)),
        mask=frame.mask((width, height)),
        border=resize_nearest(border, (width, height)) if border.any() else None,
    )


def size_within(size: Size, box: Size) -> Size:
    """``size`` (width, height) brought into ``box`` with its aspect kept; never enlarged."""
    width, height = size
    scale = min(1.0, box[0] / width, box[1] / height)
    return max(1, round(width * scale)), max(1, round(height * scale))
