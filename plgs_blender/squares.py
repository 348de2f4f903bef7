"""Points as one mesh of squares: imported clouds and the lift's Gaussians.

The mesh has nothing but vertices: the points. A modifier makes each into a square, so squares take no room in the file.
A square shows its front alone, so a room lies open from outside, like a doll's house.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import bpy
import numpy as np
from numpy.typing import NDArray

from .compat import forget_selection, new_geometry_group
from .materials import splat_material
from .owned import OwnedDataBlocks
from .surfaces import SurfaceGrid

EXTENT = 2.0
"""Half the side of a square, in standard deviations of its colour's fading."""
_SMALLEST, _LARGEST = 0.002, 0.03
"""Limits to half the side of a point's square, metres."""
Part = TypeVar("Part")
_MODIFIER = "Squares"
_KINDS = {"right": "FLOAT_VECTOR", "up": "FLOAT_VECTOR", "Col": "BYTE_COLOR", "opacity": "FLOAT"}


@dataclass(frozen=True, eq=False)
class Squares:
    """``xyz`` float32 [N, 3] m; half sides ``right`` and ``up`` float32 [N, 3] m, whose cross product is the front's
    normal; ``rgb`` uint8 [N, 3] sRGB; ``opacity`` float32 [N]; ``ids`` int32 [N] by the names of more attributes."""

    xyz: NDArray[np.float32]
    right: NDArray[np.float32]
    up: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    opacity: NDArray[np.float32]
    ids: Mapping[str, NDArray[np.int32]] = field(default_factory=dict)


def joined(parts: Sequence[Part]) -> Part:
    """Records of arrays [N, ...], and of such arrays by names, as one: one after the other."""
    first: Any = parts[0]
    columns: dict[str, Any] = {each.name: [getattr(part, each.name) for part in parts] for each in fields(first)}
    for name, values in columns.items():
        is_named = isinstance(values[0], Mapping)
        columns[name] = (
            {each: np.concatenate([part[each] for part in values]) for each in values[0]}
            if is_named
            else np.concatenate(values)
        )
    return type(parts[0])(**columns)


def place_points(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    points: tuple[NDArray[np.float32], NDArray[np.uint8]],
    viewpoints: NDArray[np.float64],
) -> bpy.types.Object:
    """Place points without classes, xyz [N, 3] metres and rgb [N, 3] sRGB, as squares that lie in their surfaces and
    face the viewpoints [V, 3].
    """
    xyz, rgb = points
    grid = SurfaceGrid.of(xyz)
    normal = grid.normals(viewpoints)
    normal[~normal.any(axis=1)] = (0.0, 0.0, 1.0)
    right, up = across(normal)
    half = grid.radii(_SMALLEST, _LARGEST)[:, None]
    squares = Squares(np.asarray(xyz, np.float32), right * half, up * half, rgb, np.ones(len(xyz), np.float32))
    return place_squares(owned, parent, key, name, squares)


def place_squares(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, key: str, name: str, squares: Squares
) -> bpy.types.Object:
    """Our object `key` with these squares: a mesh whose vertices are the points, with Col, right, up and opacity."""
    rgba = np.ones((len(squares.rgb), 4), np.float32)
    rgba[:, :3] = squares.rgb / np.float32(255)
    mesh: bpy.types.Mesh = owned.data(key, lambda: bpy.data.meshes.new(name))
    mesh.clear_geometry()
    mesh.vertices.add(len(squares.xyz))
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(squares.xyz, np.float32).ravel())
    for each in ("right", "up"):
        values = np.ascontiguousarray(getattr(squares, each), np.float32).ravel()
        mesh.attributes.new(each, "FLOAT_VECTOR", "POINT").data.foreach_set("vector", values)
    mesh.attributes.new("Col", "BYTE_COLOR", "POINT").data.foreach_set("color_srgb", rgba.ravel())
    mesh.attributes.new("opacity", "FLOAT", "POINT").data.foreach_set("value", squares.opacity)
    for each, numbers in squares.ids.items():
        mesh.attributes.new(each, "INT", "POINT").data.foreach_set("value", numbers)
    mesh.color_attributes.active_color = mesh.color_attributes["Col"]
    mesh.materials.clear()
    mesh.materials.append(splat_material(owned))
    mesh.update()
    forget_selection(mesh)
    ob = owned.object(key, name, mesh, parent)
    ob["points"] = len(squares.xyz)
    modifier = ob.modifiers.get(_MODIFIER) or ob.modifiers.new(_MODIFIER, "NODES")
    modifier.node_group = owned.block("node_groups", "squares of points", _new_group)
    if ob.modifiers[0] != modifier:
        ob.modifiers.move(ob.modifiers.find(_MODIFIER), 0)
    return ob


def across(normal: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Two unit vectors float32 [N, 3] across each unit normal [N, 3] and each other: first x second = normal."""
    aside = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(aside, normal)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    return right.astype(np.float32), np.cross(normal, right).astype(np.float32)


def _new_group() -> bpy.types.NodeTree:
    """Move each vertex to a corner of its square, draw it out to a side, and the side to the square. All that is made
    of a vertex has its attributes, and the mesh keeps its active colour. Drawn out in this order, up before right, the
    squares show their fronts. `corner` becomes the place on the square in standard deviations.
    """
    tree = new_geometry_group("PLGS squares")
    tree.is_modifier = True
    link = tree.links.new

    def add(kind: str, column: int, row: int = 0) -> bpy.types.Node:
        node = tree.nodes.new(kind)
        node.location = (220 * column, -180 * row)
        return node

    def read(name: str, row: int) -> bpy.types.NodeSocket:
        node = add("GeometryNodeInputNamedAttribute", 0, row)
        node.data_type, node.inputs["Name"].default_value = "FLOAT_VECTOR", name
        return next(socket for socket in node.outputs if socket.enabled and socket.name == "Attribute")

    def maths(operation: str, column: int, row: int, *values: object) -> bpy.types.NodeSocket:
        node = add("ShaderNodeVectorMath", column, row)
        node.operation = operation
        for value, socket in zip(values, [each for each in node.inputs if each.enabled], strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                link(value, socket)
            else:
                socket.default_value = value
        return next(each for each in node.outputs if each.enabled)

    right, up, corner = (read(name, row) for row, name in enumerate(("right", "up", "corner"), 1))
    first = maths("SCALE", 2, 1, maths("ADD", 1, 1, right, up))
    first.node.inputs["Scale"].default_value = -1.0
    sides = [maths("ADD", 1, 2 + row, each, each) for row, each in enumerate((up, right))]
    places = [(-EXTENT, -EXTENT, 0.0), (0.0, 2 * EXTENT, 0.0), (2 * EXTENT, 0.0, 0.0)]
    move = add("GeometryNodeSetPosition", 4)
    link(first, move.inputs["Offset"])
    last = move.outputs[0]
    kept = add("GeometryNodeDeleteGeometry", 3)
    link(add("NodeGroupInput", 2).outputs[0], kept.inputs[0])
    link(_away_in_renders(add, maths, maths("CROSS_PRODUCT", 1, 4, right, up), link), kept.inputs["Selection"])
    link(kept.outputs[0], move.inputs[0])
    for step, place in enumerate(places):
        column, selection = 5 + 2 * step, None
        if step:
            drawn = add("GeometryNodeExtrudeMesh", column - 1)
            drawn.mode = ("VERTICES", "EDGES")[step - 1]
            drawn.inputs["Offset Scale"].default_value = 1.0
            link(last, drawn.inputs[0])
            link(sides[step - 1], drawn.inputs["Offset"])
            last, selection = drawn.outputs[0], drawn.outputs["Top"]
        store = add("GeometryNodeStoreNamedAttribute", column)
        store.data_type, store.domain, store.inputs["Name"].default_value = "FLOAT_VECTOR", "POINT", "corner"
        value = next(each for each in store.inputs if each.enabled and each.name == "Value")
        link(maths("ADD", column, 2, corner, place), value)
        link(last, store.inputs[0])
        if selection is not None:
            link(selection, store.inputs["Selection"])
        last = store.outputs[0]
    link(last, add("NodeGroupOutput", 11).inputs[0])
    return tree


def _away_in_renders(add: Any, maths: Any, normal: bpy.types.NodeSocket, link: Any) -> bpy.types.NodeSocket:
    """Whether, in a render, a front faces away from the camera: Cycles follows rays through few clear layers."""
    place, viewport = add("GeometryNodeObjectInfo", 1, 5), add("GeometryNodeIsViewport", 1, 6)
    away, least = add("ShaderNodeMath", 3, 5), add("ShaderNodeMath", 2, 6)
    place.transform_space, away.operation = "RELATIVE", "GREATER_THAN"
    least.operation, least.inputs[1].default_value = "MULTIPLY", 1e9  # in views, which nothing reaches
    link(add("GeometryNodeInputActiveCamera", 0, 5).outputs[0], place.inputs["Object"])
    way = maths("SUBTRACT", 2, 5, add("GeometryNodeInputPosition", 0, 6).outputs[0], place.outputs["Location"])
    link(maths("DOT_PRODUCT", 3, 4, normal, way), away.inputs[0])
    link(viewport.outputs[0], least.inputs[0])
    link(least.outputs[0], away.inputs[1])
    return away.outputs[0]
