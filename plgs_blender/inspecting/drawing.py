"""Drawing over 3D views with Blender's GPU module. Other modules decide what is drawn, and where."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from ..compat import point_shader, to_overlay
from .highlight import Highlight
from .text_boxes import Colour, TextBox

_DIMMING = (0.03, 0.033, 0.04, 0.55)
_BEHIND = 0.22
"""Opacity of a highlighted point behind other things."""
_SMALLEST, _LARGEST = 2.5, 14.0
"""Limits to the size of a highlighted point, pixels."""
_PATH_COLOUR = (1.0, 0.78, 0.3, 0.9)
_JUMP = 6.0
"""A path breaks where two frames are farther apart than this many times the usual distance."""
_EDGES = (0, 1, 1, 2, 2, 3, 3, 0, 4, 5, 5, 6, 6, 7, 7, 4, 0, 4, 1, 5, 2, 6, 3, 7)
"""Pairs of corners of an object's `bound_box`."""

_uploaded: list[tuple[NDArray[np.float32], gpu.types.GPUTexture]] = []
"""The picture drawn last, and its texture."""


def draw_highlight(
    view: bpy.types.RegionView3D,
    size: tuple[int, int],
    seen: Highlight,
    box: bpy.types.Object | None,
    colour: Colour,
    dim: bool,
) -> None:
    """Darken the view (of `size` in pixels) if `dim`, then draw the points and the edges of the box in a colour (sRGB).
    Both are drawn a little nearer than they are, or the view's own points and lines would cover them.
    """
    light = _brightened(colour)
    if dim:
        _darken()
    middle = Vector(seen.xyz.mean(axis=0).tolist()) if len(seen.xyz) else Vector()
    if box is not None:
        middle = box.matrix_world.translation
    distance = max(-(view.view_matrix @ middle).z, 1e-3)
    gpu.state.blend_set("ALPHA")
    with gpu.matrix.push_pop():
        gpu.matrix.load_matrix(_nearer(view, distance, 2.0 * seen.radius + 0.01) @ view.view_matrix)
        if len(seen.xyz):
            focal = view.window_matrix[0][0] * size[0] / 2.0
            apart = distance if view.is_perspective else 1.0
            _draw_points(seen, light, min(max(2.0 * seen.radius * focal / apart, _SMALLEST), _LARGEST))
        if box is not None:
            _draw_edges([box.matrix_world @ Vector(corner) for corner in box.bound_box], light)
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("NONE")


def draw_outline(corners: Sequence[tuple[float, float]], colour: Colour) -> None:
    """A closed line through corners in pixels, the colour on dark; nothing where there are fewer than three."""
    if len(corners) < 3:
        return
    edges = [end for first in range(len(corners)) for end in (first, (first + 1) % len(corners))]
    gpu.state.blend_set("ALPHA")
    for width, ink in ((5.0, (0.0, 0.0, 0.0, 0.5)), (2.5, (*_brightened(colour), 1.0))):
        _draw_lines([Vector((x, y, 0.0)) for x, y in corners], edges, ink, width)
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


def draw_picture(pixels: NDArray[np.float32], corners: Sequence[tuple[float, float] | None]) -> None:
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
    gpu.state.blend_set("NONE")
    quad.draw(shader)


def forget_picture() -> None:
    """Free the texture of the picture drawn last."""
    _uploaded.clear()


def _texture_of(pixels: NDArray[np.float32]) -> gpu.types.GPUTexture:
    """The picture's texture. Blender's own texture of an image has mipmaps, which take ten times as long to make."""
    if not _uploaded or _uploaded[0][0] is not pixels:
        height, width, _ = pixels.shape
        drawn = to_overlay(pixels)
        values = gpu.types.Buffer("FLOAT", drawn.size, drawn.ravel())
        _uploaded[:] = [(pixels, gpu.types.GPUTexture((width, height), format="RGBA16F", data=values))]
    return _uploaded[0][1]


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


def _darken() -> None:
    """Draw one dark, half transparent rectangle over the whole region."""
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("NONE")
    with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
        gpu.matrix.load_matrix(Matrix.Identity(4))
        gpu.matrix.load_projection_matrix(Matrix.Identity(4))
        shader.bind()
        shader.uniform_float("color", _DIMMING)
        corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
        batch_for_shader(shader, "TRIS", {"pos": corners}).draw(shader)


def _nearer(view: bpy.types.RegionView3D, distance: float, by: float) -> Matrix:
    """The transform of view space that brings things at `distance` metres `by` metres nearer, at the same pixels."""
    if view.is_perspective:
        return Matrix.Diagonal([max(1.0 - by / distance, 0.5)] * 3).to_4x4()
    return Matrix.Translation((0.0, 0.0, by))


def _draw_points(seen: Highlight, colour: Colour, pixels: float) -> None:
    """Draw all points faintly, then those that nothing covers at full strength."""
    shader = point_shader()
    gpu.state.point_size_set(pixels)
    for test, opacity in (("NONE", _BEHIND), ("LESS_EQUAL", 1.0)):
        gpu.state.depth_test_set(test)
        colours = np.full((len(seen.xyz), 4), opacity, np.float32)
        colours[:, :3] = seen.shade[:, None] * np.array(colour, np.float32)
        batch_for_shader(shader, "POINTS", {"pos": seen.xyz, "color": colours}).draw(shader)


def _draw_edges(corners: Sequence[Vector], colour: Colour) -> None:
    for test, opacity in (("NONE", 0.35), ("LESS_EQUAL", 1.0)):
        gpu.state.depth_test_set(test)
        _draw_lines(corners, _EDGES, (*colour, opacity), 2.5)


def _draw_lines(
    corners: Sequence[Vector], edges: Sequence[int], colour: tuple[float, float, float, float], width: float
) -> None:
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.bind()
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", colour)
    batch_for_shader(shader, "LINES", {"pos": [tuple(corners[edge]) for edge in edges]}).draw(shader)


def _brightened(colour: Colour) -> Colour:
    """The colour of a highlight: three parts the brightest colour of its hue, one part white."""
    strongest = max(*colour, 1e-3)
    red, green, blue = (0.25 + 0.75 * channel / strongest for channel in colour)
    return red, green, blue
