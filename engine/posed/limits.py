"""What no camera makes: sizes, focal lengths and depths that a file may claim, refused with the frame's name.

Every format's frames pass here when a scene is opened, so that readers need no limits of their own.
"""

from __future__ import annotations

from pathlib import Path

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


def check_camera(name: str, camera: Camera, path: Path) -> None:
    """Raise PlgsError, with the frame's ``name``, for a lens or picture that no camera has, or a name that cannot be
    shown: it goes into panels, tables and logs as it is. ``path`` is its picture.
    """
    if not name.isprintable():
        raise PlgsError(f"the name of frame {shown(name)} cannot be shown as text", path.parent, "Rename it.")
    check_size(f"the picture of frame {shown(name)}", camera.size, path)
    least, most = (share * max(camera.size) for share in _FOCAL_LENGTHS)
    if not (least <= camera.fx <= most and least <= camera.fy <= most):
        size = shown_size(camera.size)
        what = f"frame {shown(name)} has focal lengths of {camera.fx:.4g} and {camera.fy:.4g} pixels at {size}"
        raise PlgsError(what, path, "Give its camera's focal lengths in pixels of the picture.")


def check_size(what: str, size: Size, path: Path) -> None:
    """Raise PlgsError, which begins with ``what``, for a size that no camera makes."""
    if min(size) < _SMALLEST_SIDE or max(size) > _LONGEST_SHAPE * min(size):
        fix = f"Use at least {_SMALLEST_SIDE} pixels a side, and no side over {_LONGEST_SHAPE} times the other."
        raise PlgsError(f"{what} is {shown_size(size)}, which no camera makes", path, fix)
