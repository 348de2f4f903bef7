"""Draw over 3D views with Blender's GPU module, and lay out the labels of boxes and the legend, in pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from ..compat import to_overlay
from ..errors import one_line

Colour = tuple[float, float, float]
Rectangle = tuple[float, float, float, float]
"""Left, bottom, right and top, in pixels."""

_TEXT = 11.0
_PADDING = 5.0  # pixels at interface scale 1
_MOST_COVERED = 0.03  # maximum fraction of the view that names may cover
_MOST_NAMES = 8  # maximum number of names; more would not be readable
_APART = 0.5  # minimum gap between two labels, in label heights
_DARK = (0.09, 0.095, 0.105)


@dataclass(frozen=True, eq=False)
class Mark:
    """An outline as a picture float32 [H, W, 4] in sRGB, lowest row first, and its rectangle in the region, in pixels.
    `key` says what it outlines, for a cache."""

    key: tuple[Any, ...]
    pixels: NDArray[np.float32]
    place: Rectangle


@dataclass(frozen=True)
class ViewRegion:
    """A 3D view's region: size in pixels, the width that the toolbar covers at the `left`, the matrix from world to
    clip space, and the `scale` of Blender's interface."""

    width: int
    height: int
    left: int
    perspective: Matrix
    scale: float

    @classmethod
    def of(cls, context: bpy.types.Context) -> ViewRegion:
        region, area = context.region, context.area
        tools = next((each for each in area.regions if each.type == "TOOLS"), None)
        # With Region Overlap, the toolbar lies over the view.
        left = tools.width if tools is not None and 0 <= tools.x - region.x < tools.width else 0
        scale = context.preferences.system.ui_scale
        return cls(region.width, region.height, left, context.region_data.perspective_matrix.copy(), scale)

    def pixel_of(self, point: Vector) -> tuple[float, float] | None:
        """Return the pixel of a world point, from the lower left; None if the point is behind the viewer."""
        x, y, _, w = self.perspective @ Vector((*point, 1.0))
        return (self.width * (0.5 + 0.5 * x / w), self.height * (0.5 + 0.5 * y / w)) if w > 1e-6 else None


@dataclass(frozen=True)
class TextBox:
    """A text on a rectangle, perhaps with a `swatch` of colour before it; `instance` is the instance that the text
    names, or 0. Lengths are in pixels, from the lower left corner; `size` is the text's, `ink` its colour, `ground` the
    rectangle's; colours are sRGB 0..1."""

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
    instance: int = 0


def label_text_boxes(
    rows: Any,
    boxes: Mapping[int, bpy.types.Object],
    *,
    active: int,
    region: ViewRegion,
    hovered: int = 0,
    keep_free: Sequence[Rectangle] = (),
) -> list[TextBox]:
    """Return names of the lists' `rows` above their boxes, as many as `place_labels` allows: the `active` one, the
    `hovered` one, then those that look largest, known classes first. The label of an active box out of view says so."""
    size, padding = _TEXT * region.scale, _PADDING * region.scale
    height = size + 1.4 * padding
    found: list[tuple[tuple[bool, bool, bool, float], Any, str, tuple[float, float]]] = []
    for row in rows:
        box, name = boxes.get(row.instance_id), one_line(row.name)
        if box is None:
            continue
        corners = [box.matrix_world @ Vector(corner) for corner in box.bound_box]
        middle = sum(corners, Vector()) / 8.0
        top = Vector((middle.x, middle.y, max(corner.z for corner in corners)))
        at, distance = region.pixel_of(top), (region.perspective @ Vector((*top, 1.0))).w
        seen = [each for each in map(region.pixel_of, corners) if each is not None]
        is_out = not any(0.0 <= x <= region.width and 0.0 <= y <= region.height for x, y in seen)
        if row.instance_id == active and is_out:
            at, name = (region.left + 0.3 * region.width, 2.0 * height), f"{name} is out of view: Frame Selected"
        if at is not None:
            looks = max(box.dimensions) / max(distance, 1e-6)
            rank = (row.instance_id != active, row.instance_id != hovered, is_rest(row.class_name), -looks)
            found.append((rank, row, name, (at[0], at[1] + padding)))
    found.sort(key=lambda each: each[0])
    widths = [_set_text_size(name, size) + 2.0 * padding for _, _, name, _ in found]
    places = place_labels([at for *_, at in found], widths, height, (region.width, region.height), keep_free)
    text_boxes = []
    for index, (x, y) in places.items():
        _, row, name, _ = found[index]
        red, green, blue = row.colour
        bright = row.instance_id in (active, hovered)
        shade = 1.0 if bright else 0.42
        luminance = 0.3 * red + 0.6 * green + 0.1 * blue
        text_boxes.append(
            TextBox(
                x, y, widths[index], height, name, size,
                ground=(red * shade, green * shade, blue * shade),
                opacity=0.95 if bright else 0.8,
                ink=_DARK if bright and luminance > 0.5 else (1.0, 1.0, 1.0),
                instance=row.instance_id,
            )
        )  # fmt: skip
    return text_boxes


def place_labels(
    anchors: Sequence[tuple[float, float]],
    widths: Sequence[float],
    height: float,
    space: tuple[float, float],
    keep_free: Sequence[Rectangle] = (),
) -> dict[int, tuple[float, float]]:
    """Return the lower left corners of labels above their anchors (x, y), by index, within a space (width, height), all
    in pixels. Labels that would cover an earlier one or a rectangle in `keep_free`, or are too many, are left out."""
    placed: dict[int, tuple[float, float]] = {}
    taken, room = [*keep_free], _MOST_COVERED * space[0] * space[1]
    for index, ((x, y), width) in enumerate(zip(anchors, widths, strict=True)):
        if not (0.0 <= x <= space[0] and 0.0 <= y <= space[1]):
            continue
        left = min(max(x - width / 2.0, 0.0), max(space[0] - width, 0.0))
        low = min(y, max(space[1] - height, 0.0))
        right, high = left + width, low + height
        if any(left < end and start < right and low < top and base < high for start, base, end, top in taken):
            continue
        room -= width * height
        if (room < 0.0 and placed) or len(placed) == _MOST_NAMES:  # the first is shown however large it is
            break
        placed[index] = (left, low)
        margin = _APART * height
        taken.append((left - margin, low - margin, right + margin, high + margin))
    return placed


def shown_classes(rows: Any) -> list[tuple[str, Colour]]:
    """Return the names and colours of those classes in the rows that are visible, those with most points first."""
    shown = sorted((row for row in rows if row.visible), key=lambda row: (-row.points, row.name))
    return [(one_line(row.name), tuple(row.colour)) for row in shown]


def legend_text_boxes(shown: Sequence[tuple[str, Colour | None]], region: ViewRegion) -> list[TextBox]:
    """Return the legend: as many of the classes (names and colours) as fit into the lower left corner, in order."""
    size, padding = _TEXT * region.scale, _PADDING * region.scale
    line = size + 1.2 * padding
    room = max(1, int((0.7 * region.height) / line))
    texts: list[tuple[str, Colour | None]] = [*shown[:room]]
    if len(shown) > room:
        texts[-1] = (f"and {len(shown) - room + 1} more", None)
    if not texts:
        return []
    width = max(_set_text_size(text, size) for text, _ in texts) + size + 4.0 * padding
    x, y = region.left + 3.0 * padding, 3.0 * padding
    return [
        TextBox(x, y + line * (len(texts) - 1 - place), width, line, text, size, _DARK, 0.72, swatch=swatch)
        for place, (text, swatch) in enumerate(texts)
    ]


def is_rest(class_name: str) -> bool:
    """Whether a class is a data set's catch-all, such as otherfurniture."""
    return class_name.casefold().startswith("other")


def _set_text_size(text: str, size: float) -> float:
    """Set the size of the text to be drawn next, and return the width of ``text`` in it, in pixels."""
    blf.size(0, size)
    return float(blf.dimensions(0, text)[0])


_PATH_COLOUR = (1.0, 0.78, 0.3, 0.9)
_JUMP = 6.0  # A path breaks between frames that are this many times the usual distance apart

uploaded: list[tuple[NDArray[np.float32], gpu.types.GPUTexture]] = []
"""The last drawn pictures and their textures."""
_KEPT = 3
"""Number of pictures drawn at once: the live preview, the selection and the painted points."""


def draw_outline(corners: Sequence[tuple[float, float]], colour: Colour) -> None:
    """Draw a closed line through at least three corners in pixels, in this colour with a dark edge."""
    if len(corners) < 3:
        return
    edges = [end for first in range(len(corners)) for end in (first, (first + 1) % len(corners))]
    gpu.state.blend_set("ALPHA")
    for width, ink in ((5.0, (0.0, 0.0, 0.0, 0.5)), (2.5, (*brightened(colour), 1.0))):
        _draw_lines([Vector((x, y, 0.0)) for x, y in corners], edges, ink, width)
    gpu.state.blend_set("NONE")


def draw_face(corners: Sequence[Vector], colour: tuple[float, float, float, float]) -> None:
    """Draw a face with four corners in metres, on top of everything."""
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.bind()
    shader.uniform_float("color", colour)
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRIS", {"pos": [*map(tuple, corners)]}, indices=[(0, 1, 2), (0, 2, 3)]).draw(shader)
    gpu.state.blend_set("NONE")


def draw_path(points: Sequence[Vector]) -> None:
    """Draw a line through points in metres, hidden by nearer things, with gaps where the recording jumps."""
    steps = [(end - start).length for start, end in pairwise(points)]
    longest = _JUMP * float(np.median(steps)) if steps else 0.0
    edges = [end for number, step in enumerate(steps) if step <= longest for end in (number, number + 1)]
    if not edges:
        return
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    for width, ink in ((4.0, (0.0, 0.0, 0.0, 0.4)), (2.0, _PATH_COLOUR)):
        _draw_lines(points, edges, ink, width)
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("NONE")


def draw_mark(mark: Mark | None) -> None:
    """Draw the outline of points that `mark_of` returned. None draws nothing: the points are out of view."""
    if mark is not None:
        left, low, right, high = mark.place
        draw_picture(mark.pixels, [(left, low), (right, high)], blend="ALPHA")


def draw_picture(
    pixels: NDArray[np.float32], corners: Sequence[tuple[float, float] | None], blend: str = "NONE"
) -> None:
    """Draw a picture (float32 [H, W, 4], sRGB, lowest row first) over the rectangle of these corners, in pixels. If a
    corner is None, nothing is drawn. `blend` is a mode of gpu.state.blend_set."""
    seen = [corner for corner in corners if corner is not None]
    if len(seen) != len(corners):
        return
    (left, right), (low, high) = ((min(each), max(each)) for each in zip(*seen, strict=True))
    shader = gpu.shader.from_builtin("IMAGE")
    shader.bind()
    shader.uniform_sampler("image", _texture_of(pixels))
    places = [(left, low), (right, low), (right, high), (left, high)]
    coordinates = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    quad = batch_for_shader(shader, "TRIS", {"pos": places, "texCoord": coordinates}, indices=[(0, 1, 2), (0, 2, 3)])
    gpu.state.blend_set(blend)
    quad.draw(shader)
    gpu.state.blend_set("NONE")


def _texture_of(pixels: NDArray[np.float32]) -> gpu.types.GPUTexture:
    """Make a texture of a picture [H, W, 4]. Blender's own image textures have mipmaps, which take ten times longer."""
    for picture, texture in uploaded:
        if picture is pixels:  # not ==, which would compare all values at each redraw
            return texture
    height, width, _ = pixels.shape
    drawn = to_overlay(pixels)
    values = gpu.types.Buffer("FLOAT", drawn.size, drawn.ravel())
    made = gpu.types.GPUTexture((width, height), format="RGBA16F", data=values)
    uploaded[:] = [(pixels, made), *uploaded[: _KEPT - 1]]
    return made


def draw_text_boxes(text_boxes: Sequence[TextBox]) -> None:
    """Draw all backgrounds, then all texts on them."""
    if not text_boxes:
        return
    corners: list[tuple[float, float]] = []
    colours: list[tuple[float, float, float, float]] = []
    for text_box in text_boxes:
        x, y, height = text_box.x, text_box.y, text_box.height
        _add_rectangle(
            corners, colours, x=x, y=y, width=text_box.width, height=height, colour=(*text_box.ground, text_box.opacity)
        )
        if text_box.swatch is not None:
            inset = 0.22 * height
            side = height - 2.0 * inset
            _add_rectangle(
                corners, colours, x=x + 2 * inset, y=y + inset, width=side, height=side, colour=(*text_box.swatch, 1.0)
            )
    shader = gpu.shader.from_builtin("FLAT_COLOR")
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRIS", {"pos": corners, "color": colours}).draw(shader)
    for text_box in text_boxes:
        aside = (text_box.width - _set_text_size(text_box.text, text_box.size)) / 2.0
        indent = aside if text_box.swatch is None else 1.15 * text_box.height
        blf.color(0, *text_box.ink, 1.0)
        blf.position(0, text_box.x + indent, text_box.y + (text_box.height - 0.72 * text_box.size) / 2.0, 0.0)
        blf.draw(0, text_box.text)
    gpu.state.blend_set("NONE")


def _add_rectangle(
    corners: list[tuple[float, float]],
    colours: list[Any],
    *,
    x: float,
    y: float,
    width: float,
    height: float,
    colour: Any,
) -> None:
    right, top = x + width, y + height
    corners += [(x, y), (right, y), (right, top), (x, y), (right, top), (x, top)]
    colours += [colour] * 6


def _draw_lines(
    corners: Sequence[Vector], edges: Sequence[int], colour: tuple[float, float, float, float], width: float
) -> None:
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.bind()
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", colour)
    batch_for_shader(shader, "LINES", {"pos": [tuple(corners[edge]) for edge in edges]}).draw(shader)


def brightened(colour: Colour) -> Colour:
    """Return the colour at full brightness, mixed with a quarter of white."""
    strongest = max(*colour, 1e-3)
    red, green, blue = (0.25 + 0.75 * channel / strongest for channel in colour)
    return red, green, blue
