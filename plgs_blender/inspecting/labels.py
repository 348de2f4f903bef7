"""Where names stand over the view: placing labels so that none covers another, and the legend's rows. Plain Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy

from .lookup import boxes_of

_STEP = 0.25
"""Share of a label's height by which one that would cover another moves up."""


@dataclass(frozen=True)
class Label:
    """A text box in pixels: its lower left corner, width and height, the text, and which label of the input it is."""

    x: float
    y: float
    width: float
    height: float
    index: int


def stack_labels(
    anchors: Sequence[tuple[float, float]], widths: Sequence[float], height: float, space: tuple[float, float]
) -> list[Label]:
    """Labels above their anchors [(x, y)] in pixels, within a space (width, height); those that would cover another
    move up. Anchors outside the space have no label.
    """
    placed: list[Label] = []
    order = sorted(range(len(anchors)), key=lambda index: (anchors[index][1], anchors[index][0]))
    for index in order:
        (x, y), width = anchors[index], widths[index]
        if not (0.0 <= x <= space[0] and 0.0 <= y <= space[1]):
            continue
        left = min(max(x - width / 2.0, 0.0), max(space[0] - width, 0.0))
        while any(_cover(left, y, width, height, other) for other in placed):
            y += _STEP * height
        placed.append(Label(left, y, width, height, index))
    return placed


def _cover(x: float, y: float, width: float, height: float, other: Label) -> bool:
    return x < other.x + other.width and other.x < x + width and abs(y - other.y) < height


def let_boxes_show_names(root: bpy.types.Collection, shown: bool) -> None:
    """Whether Blender itself writes the names at the boxes: not while we draw labels."""
    for box in boxes_of(root).values():
        box.show_name = shown
