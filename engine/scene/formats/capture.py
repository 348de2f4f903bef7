"""What a format's reader delivers: posed pictures in one convention, before masks and the split are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..frame import Size
from ..matrices import UpAxis
from ..sparse_points import SparsePoints
from ..splits import Split


@dataclass(frozen=True, eq=False)
class Shot:
    """One posed picture. The fields mean what they mean in ``Frame``; the camera stands in the format's own world."""

    name: str
    camera: Camera
    colour_path: Path
    read_colour: Callable[[Size | None], NDArray[np.uint8]]
    depth_path: Path | None = None
    read_depth: Callable[[Size | None], NDArray[np.float32]] | None = None
    file_shows_colour: bool = True


@dataclass(frozen=True, eq=False)
class Capture:
    """All shots in recording order.

    ``up`` is the axis of the format's world that points up, None where the format does not say; ``up_is_known`` when it
    was measured, so that cameras held sideways mean nothing. ``lost`` names pictures
    without a pose, which are left out. ``split`` is there where the reader had to know it.
    """

    shots: tuple[Shot, ...]
    up: UpAxis | None
    lost: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    points: SparsePoints | None = None
    split: Split | None = None
    up_is_known: bool = False
