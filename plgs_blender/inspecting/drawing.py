"""Drawing over 3D views with Blender's GPU module. Other modules decide what is drawn, and where."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import blf
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Vector
from numpy.typing import NDArray

from ..compat import to_overlay
from .highlight import Mark
from .text_boxes import Colour, TextBox

_PATH_COLOUR = (1.0, 0.78, 0.3, 0.9)
_JUMP = 6.0
"""A path breaks where two frames are farther apart than this many times the usual distance."""

_uploaded: list[tuple[NDArray[np.float32], gpu.types.GPUTexture]] = []
"""The pictures drawn last, and their textures."""
_KEPT = 3
"""So many pictures are drawn at once: the live preview, what is selected and what is painted."""


def draw_outline(corners: Sequence[tuple[float, float]], colour: Colour) -> None:
    """A closed line through corners in pixels, the colour on dark; nothing where there are fewer than three."""
    if len(corners) < 3:
        return
    edges = [end for first in range(len(corners)) for end in (first, (first + 1) % len(corners))]
    gpu.state.blend_set("ALPHA")
    for width, ink in ((5.0, (0.0, 0.0, 0.0, 0.5)), (2.5, (*brightened(colour), 1.0))):
        _draw_lines([Vector((x, y, 0.0)) for x, y in corners], edges, ink, width)
    gpu.state.blend_set("NONE")


def draw_face(corners: Sequence[Vector], colour: tuple[float, float, float, float]) -> None:
    """A face with four corners in metres, over everything."""
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.bind()
    shader.uniform_float("color", colour)
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRIS", {"pos": [*map(tuple, corners)]}, indices=[(0, 1, 2), (0, 2, 3)]).draw(shader)
    gpu.state.blend_set("NONE")


def draw_path(points: Sequence[Vector]) -> None:
    """A line through points in metres, one after the other, behind what is nearer. A step that is much longer than
    usual is a jump to another part of a recording, and gets no line.
    """
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
    """The outline of points, if any of them is in the view."""
    if mark is not None:
        left, low, right, high = mark.place
        draw_picture(mark.pixels, [(left, low), (right, high)], blend="ALPHA")


def draw_picture(
    pixels: NDArray[np.float32], corners: Sequence[tuple[float, float] | None], blend: str = "NONE"
) -> None:
    """A picture (float32 [H, W, 4], sRGB, lowest row first) over the upright rectangle of these corners, in pixels."""
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


def forget_pictures() -> None:
    """Free the textures of the pictures drawn last."""
    _uploaded.clear()


def _texture_of(pixels: NDArray[np.float32]) -> gpu.types.GPUTexture:
    """The picture's texture. Blender's own texture of an image has mipmaps, which take ten times as long to make."""
    for picture, texture in _uploaded:
        if picture is pixels:
            return texture
    height, width, _ = pixels.shape
    drawn = to_overlay(pixels)
    values = gpu.types.Buffer("FLOAT", drawn.size, drawn.ravel())
    made = gpu.types.GPUTexture((width, height), format="RGBA16F", data=values)
    _uploaded[:] = [(pixels, made), *_uploaded[: _KEPT - 1]]
    return made


def draw_text_boxes(text_boxes: Sequence[TextBox]) -> None:
    """Draw all backgrounds, then all texts on them."""
    if not text_boxes:
        return
    corners: list[tuple[float, float]] = []
    colours: list[tuple[float, float, float, float]] = []
    for text_box in text_boxes:
        x, y, height = text_box.x, text_box.y, text_box.height
        _add_rectangle(corners, colours, x, y, text_box.width, height, (*text_box.ground, text_box.opacity))
        if text_box.swatch is not None:
            inset = 0.22 * height
            side = height - 2.0 * inset
            _add_rectangle(corners, colours, x + 2 * inset, y + inset, side, side, (*text_box.swatch, 1.0))
    shader = gpu.shader.from_builtin("FLAT_COLOR")
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRIS", {"pos": corners, "color": colours}).draw(shader)
    for text_box in text_boxes:
        _write(text_box)
    gpu.state.blend_set("NONE")


def _write(text_box: TextBox) -> None:
    blf.size(0, text_box.size)
    blf.color(0, *text_box.ink, 1.0)
    width = blf.dimensions(0, text_box.text)[0]
    indent = (text_box.width - width) / 2.0 if text_box.swatch is None else 1.15 * text_box.height
    blf.position(0, text_box.x + indent, text_box.y + (text_box.height - 0.72 * text_box.size) / 2.0, 0.0)
    blf.draw(0, text_box.text)


def _add_rectangle(
    corners: list[tuple[float, float]], colours: list[Any], x: float, y: float, width: float, height: float, colour: Any
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
    """The colour of a highlight: three parts the brightest colour of its hue, one part white."""
    strongest = max(*colour, 1e-3)
    red, green, blue = (0.25 + 0.75 * channel / strongest for channel in colour)
    return red, green, blue
