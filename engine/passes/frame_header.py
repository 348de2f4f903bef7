"""What the header of a baked view says of its frame and camera, in OpenEXR's standard attributes.

https://openexr.com/en/latest/StandardAttributes.html defines them. Its matrices are multiplied from the left by points
in rows. Its camera looks along +z with x to the right and y up. (0, 0) to (1, 1) in its NDC is the display window, from
the upper left corner to the lower right one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera

_SQUARE = 0.01
"""Pixels that are square but for this share are noted as square: a calibration is no more exact."""
_MOST_RATE = 60
"""Frames per second that a time code can count."""


@dataclass(frozen=True)
class ShownFrame:
    """A view's ``number`` in its shot (None: the last one in its name), frames per second (``fps``; None: it has no
    time), and the ``display`` window in the picture: left, top, width and height in pixels (None: the whole picture).
    """

    number: int | None = None
    fps: float | None = None
    display: tuple[int, int, int, int] | None = None


NOTHING_SHOWN = ShownFrame()


def frame_header(camera: Camera, shown: ShownFrame, name: str) -> dict[str, Any]:
    """The attributes of the view ``name``, whose picture ``camera`` shows."""
    import OpenEXR

    left, top, width, height = shown.display or (0, 0, *camera.size)
    aspect = camera.fy / camera.fx
    header: dict[str, Any] = {
        "dataWindow": _box(-left, -top, *camera.size),
        "displayWindow": _box(0, 0, width, height),
        "pixelAspectRatio": 1.0 if abs(aspect - 1.0) < _SQUARE else aspect,
        "worldToCamera": _in_rows(np.diag([1.0, -1.0, 1.0, 1.0]) @ camera.world_to_camera),
        "worldToNDC": _in_rows(_to_ndc(camera, left, top, width, height) @ camera.world_to_camera),
    }
    number = number_in(name) if shown.number is None else shown.number
    if number is not None:
        header["imageCounter"] = number
    rate = 0 if shown.fps is None else round(shown.fps)
    if number is not None and number >= 0 and 0 < rate <= _MOST_RATE:
        seconds, frame = divmod(number, rate)
        clock = seconds // 3600 % 24, seconds // 60 % 60, seconds % 60, frame
        header["timeCode"] = OpenEXR.TimeCode(*clock, *(14 * (0,)))
    return header


def number_in(name: str) -> int | None:
    """The number of the frame of this name: the last one in it, -3 in "shot.-003"."""
    found = re.search(r"((?<=\.)-)?(\d{1,9})\D*$", name)
    return None if found is None else int((found[1] or "") + found[2])


def _box(left: int, top: int, width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


def _to_ndc(camera: Camera, left: int, top: int, width: int, height: int) -> NDArray[np.float64]:
    """From the engine's camera space to NDC, float64 [4, 4]; z becomes 1 / depth."""
    matrix = np.zeros((4, 4))
    matrix[0, [0, 2]] = camera.fx / width, (camera.cx - left) / width
    matrix[1, [1, 2]] = camera.fy / height, (camera.cy - top) / height
    matrix[2, 3] = matrix[3, 2] = 1.0
    return matrix


def _in_rows(matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.ascontiguousarray(matrix.T, np.float32)
