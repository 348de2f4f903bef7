"""The blocks of a building: where they lie, and which frames see them (ours, beyond the paper).

A building is cut by what was seen, not by time: a cell with too many seen points is halved across its longer side, seen
from above. A block is lifted from all frames that see a fair part of its cell. So neighbours share frames, and the
points that both saw tell which of their objects are one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed import size_within
from .frame import Frame, Scene
from .view import read_ahead

SEEN_WITHIN = (40, 40)
"""Pixels (width, height) of the box within which depth is read to find out what a frame sees."""
MARGIN = 0.5
"""Metres around a cell that its block also sees."""
LEAST_SHARE = 0.1
"""A block is lifted from the frames that have at least this share of their points in its cell and margin."""
LEAST_FRAMES = 3


@dataclass(frozen=True, eq=False)
class Cell:
    """The part of the world between ``low`` and ``high`` float64 [2], metres along x and y, infinite at the outside.
    Cells do not overlap and leave nothing out."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def contains(self, xyz: NDArray[np.floating], margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points [N, 3] lie in the cell, or within ``margin`` metres of it, bool [N]."""
        flat = xyz[:, :2]
        inside: NDArray[np.bool_] = ((flat >= self.low - margin) & (flat < self.high + margin)).all(1)
        return inside


def cut(points: NDArray[np.floating], blocks: int) -> list[Cell]:
    """As many cells as ``blocks``, each with about as many of the ``points`` [N, 3] as the others."""
    whole = Cell(np.full(2, -np.inf), np.full(2, np.inf))
    return _halved(whole, np.asarray(points[:, :2], np.float64), blocks)


def _halved(cell: Cell, points: NDArray[np.float64], blocks: int) -> list[Cell]:
    if blocks == 1:
        return [cell]
    axis = int(np.ptp(points, axis=0).argmax()) if len(points) else 0
    first = blocks // 2
    middle = float(np.quantile(points[:, axis], first / blocks)) if len(points) else 0.0
    wall = min(max(middle, cell.low[axis]), cell.high[axis])
    high, low = cell.high.copy(), cell.low.copy()
    high[axis] = low[axis] = wall
    below = points[:, axis] < wall
    lower, upper = Cell(cell.low, high), Cell(low, cell.high)
    return [*_halved(lower, points[below], first), *_halved(upper, points[~below], blocks - first)]


def cells_of(
    scene: Scene, blocks: int, progress: Callable[[int, int], object]
) -> tuple[list[Cell], list[NDArray[np.float32]]]:
    """The cells of a scene, and the points [n, 3] that each of its frames to train on sees. They are always the same.
    Raises PlgsError for more blocks than the scene has frames for."""
    frames = scene.train_frames
    if blocks * LEAST_FRAMES > len(frames):
        fix = f"Give at most {len(frames) // LEAST_FRAMES}."
        raise PlgsError(f"{len(frames)} frames are too few for {blocks} blocks", scene.folder, fix, option="--blocks")
    seen = []
    for done, points in enumerate(read_ahead(frames, seen_points), start=1):
        seen.append(points)
        progress(done, len(frames))
    return cut(np.concatenate(seen), blocks), seen


def seen_points(frame: Frame) -> NDArray[np.float32]:
    """Points float32 [n, 3] of a frame's depth, at a small size; none where it cannot be read, so that no block has the
    frame."""
    size = size_within(frame.size, SEEN_WITHIN)
    try:
        depth = frame.depth(size)
    except PlgsError:  # the check of the whole scene has named it
        return np.zeros((0, 3), np.float32)
    return frame.camera.resized(*size).unproject(depth)[depth > 0].astype(np.float32)


def frames_of(cell: Cell, frames: Sequence[Frame], seen: Sequence[NDArray[np.float32]]) -> list[Frame]:
    """The frames that see enough of a cell."""
    near = (cell.contains(points, MARGIN) for points in seen)
    return [frame for frame, mine in zip(frames, near, strict=True) if mine.any() and mine.mean() >= LEAST_SHARE]


def scene_of_block(whole: Scene, blocks: int, block: int, progress: Callable[[int, int], object]) -> Scene:
    """The scene of one of its ``blocks``, counted from 1: the frames to train on that see it. Raises PlgsError."""
    cells, seen = cells_of(whole, blocks, progress)
    frames = frames_of(cells[block - 1], whole.train_frames, seen)
    if len(frames) < LEAST_FRAMES:
        what = f"only {len(frames)} frames see block {block} of {blocks}"
        raise PlgsError(what, whole.folder, "Lift in fewer blocks.", option="--blocks")
    return replace(whole, frames=tuple(frames))
