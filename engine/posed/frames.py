"""Posed frames: where each picture was taken, and the file that shows it. This is all that Blender needs of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .classes import ClassTable

Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """The points of the reconstruction that a scene's poses come from.

    ``xyz`` is floats [N, 3] in the world of the poses, ``rgb`` uint8 [N, 3] sRGB. ``seen_by`` maps a frame's name to
    the indices int64 [K] of the points that were found in its picture. It is empty in formats without tracks.
    """

    xyz: NDArray[np.floating]
    rgb: NDArray[np.uint8]
    seen_by: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.xyz)

    def turned(self, turn: NDArray[np.float64]) -> SparsePoints:
        """The same points in the world that the rotation ``turn``, float64 [3, 3], makes."""
        return SparsePoints(self.xyz @ turn.T, self.rgb, self.seen_by)


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """One picture and the camera that took it.

    ``colour_path`` and ``depth_path`` are the files that hold the pixels; a frame without depth has no
    ``depth_path``. ``file_shows_colour`` is true when the file at ``colour_path`` is an image that shows the frame as
    it is. It is false for videos, archives, and pictures that are undistorted on reading.
    """

    name: str
    camera: Camera
    held_out: bool
    colour_path: Path
    depth_path: Path | None
    file_shows_colour: bool = field(default=True, kw_only=True)

    @property
    def size(self) -> Size:
        return self.camera.width, self.camera.height


@dataclass(frozen=True, eq=False)
class PosedScene:
    """Posed frames in recording order, the classes of their masks, and what a user should know about them.

    ``folder`` is what the user named: a folder, or the one file that holds it all. ``format`` is the name of its
    reader. ``points`` are those of the reconstruction that the poses come from, if the format has them. ``turn``,
    float64 [3, 3], is the rotation that made z point up, or None.
    """

    folder: Path
    frames: tuple[PosedFrame, ...]
    classes: ClassTable
    warnings: tuple[str, ...] = ()
    format: str = "scannet"
    points: SparsePoints | None = None
    turn: NDArray[np.float64] | None = None


def size_within(size: Size, box: Size) -> Size:
    """``size`` (width, height) reduced to fit into ``box`` with its aspect kept; never enlarged."""
    width, height = size
    scale = min(1.0, box[0] / width, box[1] / height)
    return max(1, round(width * scale)), max(1, round(height * scale))
