"""What no camera makes: sizes, focal lengths and depths that a file may claim, refused with the frame's name.

Every format's frames pass here when a scene is opened, so that readers need no limits of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from .camera import Camera
from .frames import Size
from .layout import shown, shown_size

LARGEST_PIXELS = 2**27
_SMALLEST_SIDE = 4
_LONGEST_SHAPE = 20
"""The longer side of a picture by the shorter one."""
_FOCAL_LENGTHS = (0.001, 1000.0)
"""In longer sides of the picture: an angle of view of 179.9 degrees, and of 0.06."""
_DEPTHS = (0.0005, 10_000.0)
"""Metres. Half a step of the 16-bit images that hold millimetres, and as far as a camera may be from the origin."""


def check_camera(name: str, camera: Camera, path: Path) -> None:
    """Raise PlgsError, with the frame's ``name``, for a lens or picture that no camera has, or a name that cannot be
    shown: it goes into panels, tables and logs as it is. ``path`` is its picture.
    """
    if not name.isprintable():
        raise PlgsError(f"the name of frame {shown(name)} cannot be shown as text", path.parent, "Rename it.")
    _check_size(f"the picture of frame {shown(name)}", camera.size, path)
    least, most = (share * max(camera.size) for share in _FOCAL_LENGTHS)
    if not (least <= camera.fx <= most and least <= camera.fy <= most):
        size = shown_size(camera.size)
        what = f"frame {shown(name)} has focal lengths of {camera.fx:.4g} and {camera.fy:.4g} pixels at {size}"
        raise PlgsError(what, path, "Give its camera's focal lengths in pixels of the picture.")


def depth_check(name: str, path: Path) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """A function that checks planar depth, float32 [H, W] metres with 0 = none, and returns it unchanged.

    It raises PlgsError, with the frame's ``name`` and the file ``path``, for a size or lengths that no sensor gives.
    """

    def check(depth: NDArray[np.float32]) -> NDArray[np.float32]:
        _check_size(f"depth of frame {shown(name)}", (depth.shape[1], depth.shape[0]), path)
        farthest = float(depth.max())
        if farthest > 0.0 and not _DEPTHS[0] <= farthest <= _DEPTHS[1]:
            what = f"the largest depth of frame {shown(name)} is {farthest:.4g} m, which no sensor measures"
            raise PlgsError(what, path, "Give depth in metres as floats, or in millimetres as whole numbers.")
        return depth

    return check


def _check_size(what: str, size: Size, path: Path) -> None:
    if min(size) < _SMALLEST_SIDE or max(size) > _LONGEST_SHAPE * min(size):
        fix = f"Use at least {_SMALLEST_SIDE} pixels a side, and no side over {_LONGEST_SHAPE} times the other."
        raise PlgsError(f"{what} is {shown_size(size)}, which no camera makes", path, fix)
