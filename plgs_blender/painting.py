"""Which points the user paints in a 3D view, with a brush or a rectangle, and what the view shows of it meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.corrections import read_corrected
from ..engine.errors import PlgsError
from .inspecting.drawing import draw_mark, draw_outline
from .inspecting.highlight import Highlight, mark_of

_CELL = 8
"""Pixels: in each such square the nearest point hides what lies behind it."""
_BEHIND = 0.15
"""Metres that a point may lie behind the nearest one and still be painted."""
_RADIUS = 24.0
"""The brush's initial radius in pixels."""
_COLOUR = (1.0, 0.55, 0.1)
_POINT, _TINT = 0.01, 0.4
"""Radius in metres of a painted point as it is shown, and the opacity of its colour."""

Place = tuple[float, float]


@dataclass(eq=False)
class Painting:
    """One painting, until Enter. ``xyz`` float32 [N, 3]: the lift's points, ``chosen`` bool [N]: those that are
    painted. ``places``: where the mouse was since its button went down, pixels of the view, y up; ``mouse``: where it
    is. The drag is a rectangle where it ``is_box``, and takes points away where it ``is_eraser``.
    """

    xyz: NDArray[np.float32]
    chosen: NDArray[np.bool_]
    radius: float = _RADIUS
    places: list[Place] = field(default_factory=list)
    mouse: Place = (0.0, 0.0)
    is_box: bool = False
    is_eraser: bool = False
    _shown: Highlight | None = None

    @classmethod
    def of(cls, xyz: NDArray[np.float32]) -> Painting:
        """Nothing is painted yet."""
        return cls(xyz, np.zeros(len(xyz), bool))

    @classmethod
    def of_lift(cls, folder: Path) -> Painting:
        """The same, on the points of the lift in a folder. Raises PlgsError."""
        return cls.of(read_corrected(folder).points.xyz)

    def press(self, place: Place, *, is_box: bool, is_eraser: bool) -> None:
        self.places, self.is_box, self.is_eraser = [place], is_box, is_eraser

    def move(self, place: Place) -> None:
        """The mouse moves; with its button down the stroke goes on."""
        self.mouse = place
        if self.places:
            self.places.append(place)

    def release(self, to_view: NDArray[np.float64], size: tuple[int, int]) -> None:
        """End the drag. Its points are found at once, so the view may be turned before the next one."""
        if self.places:
            pick = boxed if self.is_box else painted
            self.chosen[pick(self.xyz, to_view, size, self.places, self.radius)] = not self.is_eraser
            self.places, self._shown = [], None

    def choose(self, xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
        """What was chosen of a result's points [N, 3], bool [N]. Raises PlgsError when the points have changed."""
        if xyz.shape != self.xyz.shape:
            raise PlgsError("the lift's points have changed", "Paint Points", "Show its result again, then paint.")
        return self.chosen

    def draw(self, view: bpy.types.RegionView3D, size: tuple[int, int]) -> None:
        """In pixels: the chosen points, and the brush or the rectangle that is dragged."""
        if self._shown is None:
            self._shown = Highlight(("painted", self.chosen.tobytes()), self.xyz[self.chosen], _POINT)
        draw_mark(mark_of(self._shown, view, size, _COLOUR, _TINT))
        x, y = self.mouse
        if self.is_box and self.places:
            left, low = self.places[0]
            draw_outline([(left, low), (x, low), (x, y), (left, y)], _COLOUR)
        else:
            turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
            circle = np.array(self.mouse) + self.radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            draw_outline([(float(u), float(v)) for u, v in circle], _COLOUR)


now: list[Painting] = []
"""The painting in progress, for the overlay; at most one."""


def visible(
    xyz: NDArray[np.float32], to_view: NDArray[np.float64], size: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The points of [N, 3] that nothing hides in a view: int64 [n], and their pixels, float64 [n, 2], y up.
    ``to_view`` [4, 4] is the view's perspective matrix, ``size`` its width and height in pixels."""
    seen = np.c_[xyz, np.ones(len(xyz))] @ to_view.T
    depth = seen[:, 3]
    pixel = (seen[:, :2] / np.where(depth > 1e-6, depth, np.inf)[:, None] * 0.5 + 0.5) * np.array(size)
    inside = (depth > 1e-6) & (pixel >= 0).all(axis=1) & (pixel < np.array(size)).all(axis=1)
    rows = np.flatnonzero(inside)
    cell = (pixel[rows] // _CELL).astype(np.int64) @ np.array([1, size[0] // _CELL + 1])
    nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(nearest, cell, depth[rows])
    rows = rows[depth[rows] <= nearest[cell] + _BEHIND]
    return rows, pixel[rows]


def painted(
    xyz: NDArray[np.float32],
    to_view: NDArray[np.float64],
    size: tuple[int, int],
    stroke: Sequence[Place],
    radius: float,
) -> NDArray[np.bool_]:
    """The ``visible`` points under a stroke, bool [N]. ``stroke``: the brush's places in pixels, and ``radius`` its
    own."""
    rows, pixel = visible(xyz, to_view, size)
    under = np.zeros(len(rows), bool)
    for place in stroke:
        under |= ((pixel - np.array(place)) ** 2).sum(axis=1) <= radius**2
    return _chosen(rows[under], len(xyz))


def boxed(
    xyz: NDArray[np.float32], to_view: NDArray[np.float64], size: tuple[int, int], drag: Sequence[Place], _: float = 0.0
) -> NDArray[np.bool_]:
    """The ``visible`` points in the rectangle between the ends of a drag, bool [N]."""
    rows, pixel = visible(xyz, to_view, size)
    low, high = np.sort([drag[0], drag[-1]], axis=0)
    return _chosen(rows[((pixel >= low) & (pixel <= high)).all(axis=1)], len(xyz))


def _chosen(rows: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    chosen = np.zeros(count, bool)
    chosen[rows] = True
    return chosen
