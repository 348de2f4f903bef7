"""The labels at boxes and the legend: text boxes with places in pixels and colours, which `drawing` draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import blf
import bpy
from mathutils import Matrix, Vector

from ..errors import one_line

Colour = tuple[float, float, float]

_TEXT = 11.0
_PADDING = 5.0
"""Pixels at interface scale 1."""
_MOST_LABELS = 120
_STEP = 0.25
"""Share of a label's height by which a label moves up that would cover another."""
_FARTHEST = 4.0
"""Heights of a label that it may move up. Farther from its box, it would seem to name another."""
_DARK = (0.09, 0.095, 0.105)


@dataclass(frozen=True)
class ViewRegion:
    """A 3D view's region: `width` and `height` in pixels, the pixels that toolbars cover on the `left`, the matrix from
    world to clip space, and the interface's scale.
    """

    width: int
    height: int
    left: int
    perspective: Matrix
    scale: float

    @classmethod
    def of(cls, context: bpy.types.Context) -> ViewRegion:
        region, area = context.region, context.area
        tools = next((each for each in area.regions if each.type == "TOOLS"), None)
        covered = tools is not None and tools.x < region.x + tools.width and tools.x >= region.x
        left = tools.width if tools is not None and covered else 0
        scale = context.preferences.system.ui_scale
        return cls(region.width, region.height, left, context.region_data.perspective_matrix.copy(), scale)

    def pixel_of(self, point: Vector) -> tuple[float, float] | None:
        """The pixel of a world point, counted from the lower left; None when the point is behind the eye."""
        x, y, _, w = self.perspective @ Vector((*point, 1.0))
        return (self.width * (0.5 + 0.5 * x / w), self.height * (0.5 + 0.5 * y / w)) if w > 1e-6 else None


@dataclass(frozen=True)
class TextBox:
    """A rectangle with a text. Its lower left corner, width, height and the text's size are in pixels, colours are sRGB
    0..1. A swatch of colour stands before the text where `swatch` is not None.
    """

    x: float
    y: float
    width: float
    height: float
    text: str
    size: float
    ground: Colour
    opacity: float
    ink: Colour = (1.0, 1.0, 1.0)
    swatch: Colour | None = None


def label_text_boxes(
    rows: Any, boxes: Mapping[int, bpy.types.Object], active: int, region: ViewRegion
) -> list[TextBox]:
    """A text box with the name above the box of each instance that is seen. The `active` one has its full colour."""
    size, padding = _TEXT * region.scale, _PADDING * region.scale
    seen: list[Any] = []
    anchors: list[tuple[float, float]] = []
    widths: list[float] = []
    for row in rows:
        box = boxes.get(row.instance_id)
        at = None if box is None else region.pixel_of(top_of(box))
        if at is not None and len(seen) < _MOST_LABELS:
            seen.append(row)
            anchors.append((at[0], at[1] + padding))
            widths.append(_text_width(one_line(row.name), size) + 2.0 * padding)
    text_boxes = []
    height = size + 1.4 * padding
    for index, (x, y) in stack_labels(anchors, widths, height, (region.width, region.height)).items():
        row = seen[index]
        red, green, blue = row.colour
        bright = row.instance_id == active
        shade = 1.0 if bright else 0.42
        luminance = 0.3 * red + 0.6 * green + 0.1 * blue
        text_boxes.append(
            TextBox(
                x, y, widths[index], height, one_line(row.name), size,
                ground=(red * shade, green * shade, blue * shade),
                opacity=0.95 if bright else 0.8,
                ink=_DARK if bright and luminance > 0.5 else (1.0, 1.0, 1.0),
            )
        )  # fmt: skip
    return text_boxes


def stack_labels(
    anchors: Sequence[tuple[float, float]], widths: Sequence[float], height: float, space: tuple[float, float]
) -> dict[int, tuple[float, float]]:
    """The lower left corners of labels above their anchors [(x, y)], by the labels' indices, within a space (width,
    height), all in pixels. Labels that would cover another move up; those that would have to move far are left out.
    Anchors outside the space have no label.
    """
    placed: dict[int, tuple[float, float]] = {}
    for index in sorted(range(len(anchors)), key=lambda index: (anchors[index][1], anchors[index][0])):
        (x, y), width = anchors[index], widths[index]
        if not (0.0 <= x <= space[0] and 0.0 <= y <= space[1]):
            continue
        left = min(max(x - width / 2.0, 0.0), max(space[0] - width, 0.0))
        crossing = [low for i, (at, low) in placed.items() if left < at + widths[i] and at < left + width]
        while any(abs(y - low) < height for low in crossing):
            y += _STEP * height
        if y - anchors[index][1] <= _FARTHEST * height:
            placed[index] = (left, y)
    return placed


def shown_classes(rows: Any) -> list[tuple[str, Colour]]:
    """The names and colours of the classes that are shown, those with most points first."""
    shown = sorted((row for row in rows if row.visible), key=lambda row: (-row.points, row.name))
    return [(one_line(row.name), tuple(row.colour)) for row in shown]


def legend_text_boxes(shown: Sequence[tuple[str, Colour]], region: ViewRegion) -> list[TextBox]:
    """As many of the classes, names and colours, as fit into the lower left corner, in order."""
    size, padding = _TEXT * region.scale, _PADDING * region.scale
    line = size + 1.2 * padding
    room = max(1, int((0.7 * region.height) / line))
    texts: list[tuple[str, Colour | None]] = [*shown[:room]]
    if len(shown) > room:
        texts[-1] = (f"and {len(shown) - room + 1} more", None)
    if not texts:
        return []
    width = max(_text_width(text, size) for text, _ in texts) + size + 4.0 * padding
    x, y = region.left + 3.0 * padding, 3.0 * padding
    return [
        TextBox(x, y + line * (len(texts) - 1 - place), width, line, text, size, _DARK, 0.72, swatch=swatch)
        for place, (text, swatch) in enumerate(texts)
    ]


def top_of(box: bpy.types.Object) -> Vector:
    """The middle of a box's upper face, world metres."""
    corners = [box.matrix_world @ Vector(corner) for corner in box.bound_box]
    middle = sum(corners, Vector()) / 8.0
    return Vector((middle.x, middle.y, max(corner.z for corner in corners)))


def _text_width(text: str, size: float) -> float:
    blf.size(0, size)
    return float(blf.dimensions(0, text)[0])
