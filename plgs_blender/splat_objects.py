"""Splats as objects: from 5.3 on, points that Blender itself draws as splats; and points as one mesh of squares, for
imported clouds and, before 5.3, the lift's Gaussians. Squares that face away are hidden, so from outside a room lies
open. The mesh has only vertices: the points. A modifier turns each into a square, so squares take no space in the
file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import bpy
import numpy as np
from numpy.typing import NDArray

from .clouds import SurfaceGrid, set_attributes
from .compat import forget_selection, new_geometry_group
from .materials import add_node, point_material, splat_material
from .owned import OwnedDataBlocks

NAME = "Open room"


def open_room(owned: OwnedDataBlocks, clouds: Iterable[bpy.types.Object]) -> None:
    """Put the modifier on clouds that have the attribute `normal`; a cloud that has it keeps its settings."""
    for cloud in clouds:
        material, of_splats = (point_material(owned), "") if cloud.data.materials else (None, " of splats")
        group = owned.block("node_groups", f"open room{of_splats}", partial(_group, material))
        modifier = cloud.modifiers.get(NAME)
        if modifier is None:
            modifier = cloud.modifiers.new(NAME, "NODES")
        modifier.node_group = group


def _group(material: bpy.types.Material | None) -> bpy.types.NodeTree:
    """Make the node group that deletes points with normal · (position - camera) > 0, and sets ``material``, if any."""
    tree = new_geometry_group("PLGS open room")
    add = partial(add_node, tree)
    start, position = add("NodeGroupInput", 0, 0).outputs[0], add("GeometryNodeInputPosition", 1, -480).outputs[0]
    camera = add("GeometryNodeInputActiveCamera", 0, -160).outputs[0]
    eye = add("GeometryNodeObjectInfo", 1, -320, camera, transform_space="RELATIVE").outputs["Location"]
    normal = read_attribute(tree, "normal", 2, -640)
    away = add("ShaderNodeVectorMath", 3, 0, position, eye, operation="SUBTRACT").outputs["Vector"]
    facing = add("ShaderNodeVectorMath", 4, 0, away, normal, operation="DOT_PRODUCT").outputs["Value"]
    behind = add("ShaderNodeMath", 5, 0, facing, 0.0, operation="GREATER_THAN").outputs[0]
    kept = add("GeometryNodeDeleteGeometry", 6, 0, start, behind, domain="POINT").outputs[0]
    # Geometry nodes lose the materials of point clouds. Splats have none.
    dyed = add("GeometryNodeSetMaterial", 7, 0, kept, material is not None, material).outputs[0]
    add("NodeGroupOutput", 8, 0, dyed)
    return tree


def read_attribute(
    tree: bpy.types.NodeTree, name: str, column: int, row: int, kind: str = "FLOAT_VECTOR"
) -> bpy.types.NodeSocket:
    """Add a node that reads the attribute ``name`` of this data type (``kind``), and return its output."""
    node = add_node(tree, "GeometryNodeInputNamedAttribute", column, row, name, data_type=kind)
    return next(socket for socket in node.outputs if socket.enabled and socket.name == "Attribute")


HARMONIC = 0.28209479177387814
_KIND, _BASE = "GAUSSIAN_SPLAT", "radiance:base"


@dataclass(frozen=True, eq=False)
class Splats:
    """Native splats: ``xyz`` float32 [N, 3] m; ``deviations`` float32 [N, 3] m along axes rotated by ``turns`` float32
    [N, 4], quaternions wxyz; ``opacity`` float32 [N]; ``rgb`` uint8 [N, 3] sRGB; ``normal`` float32 [N, 3]: a splat is
    hidden if it points away from the camera; ``ids`` int32 [N], by attribute name."""

    xyz: NDArray[np.float32]
    deviations: NDArray[np.float32]
    turns: NDArray[np.float32]
    opacity: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    normal: NDArray[np.float32]
    ids: Mapping[str, NDArray[np.int32]]


def are_known() -> bool:
    """Whether this Blender has native splats."""
    kind = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kind is not None and _KIND in kind.enum_items


def place_splats(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, key: str, name: str, splats: Splats
) -> bpy.types.Object:
    """Return our object `key` with these splats, coloured by their attribute Col. After changing Col, call `dye`."""
    cloud: Any = owned.data(key, lambda: bpy.data.pointclouds.new(name))
    cloud.resize(len(splats.xyz))
    cloud.type = _KIND
    rgba = np.ones((2, len(splats.xyz), 4), np.float32)
    rgba[0, :, :3], rgba[1, :, 3] = splats.rgb / np.float32(255), splats.opacity
    columns = {
        "position": ("FLOAT_VECTOR", splats.xyz),
        "scale": ("FLOAT_VECTOR", splats.deviations),
        "rotation": ("QUATERNION", splats.turns),
        "normal": ("FLOAT_VECTOR", splats.normal),
        "Col": ("BYTE_COLOR", rgba[0]),
        _BASE: ("FLOAT4", rgba[1]),
        **{each: ("INT", numbers) for each, numbers in splats.ids.items()},
    }
    for old in {layer.name for layer in cloud.attributes} - columns.keys():  # such as what was hidden
        cloud.attributes.remove(cloud.attributes[old])
    set_attributes(cloud, columns)
    dye(cloud)
    ob = owned.object(key, name, cloud, parent)
    open_room(owned, [ob])
    ob["points"] = len(splats.xyz)
    return ob


def axes_of(turns: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the unit axes of Gaussians rotated by quaternions wxyz [M, 4], float32 [M, axis, xyz]."""
    w, x, y, z = turns.T / np.maximum(np.linalg.norm(turns, axis=1), 1e-12)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ],
        np.float32,
    ).transpose(2, 0, 1)


def dye(cloud: bpy.types.PointCloud) -> None:
    """Give native splats the colours of their attribute Col. Other clouds and meshes are left alone."""
    base = cloud.attributes.get(_BASE)
    if base is None:
        return
    values, colours = np.empty((2, len(base.data), 4), np.float32)
    base.data.foreach_get("vector", values.ravel())
    cloud.attributes["Col"].data.foreach_get("color_srgb", colours.ravel())
    values[:, :3] = (colours[:, :3] - 0.5) / HARMONIC  # as spherical harmonics of degree 0
    base.data.foreach_set("vector", values.ravel())
    cloud.update_tag()


EXTENT = 2.0
"""Half the side of a square, in standard deviations of its fading colour."""
_SMALLEST, _LARGEST = 0.002, 0.03  # limits of half the side of a point's square, in metres
Part = TypeVar("Part")
_MODIFIER = "Squares"


@dataclass(frozen=True, eq=False)
class Squares:
    """Squares: centres ``xyz`` float32 [N, 3] m; half sides ``right`` and ``up`` float32 [N, 3] m, whose cross product
    is the front's normal; ``rgb`` uint8 [N, 3] sRGB; ``opacity`` float32 [N]; ``ids`` int32 [N], by attribute name."""

    xyz: NDArray[np.float32]
    right: NDArray[np.float32]
    up: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    opacity: NDArray[np.float32]
    ids: Mapping[str, NDArray[np.int32]] = field(default_factory=dict)


def joined(parts: Sequence[Part]) -> Part:
    """Concatenate records of one class, field by field: arrays [N, ...], or dicts of such arrays."""
    columns: dict[str, Any] = {}
    for name in vars(parts[0]):
        values = [getattr(part, name) for part in parts]
        if isinstance(values[0], Mapping):
            columns[name] = {each: np.concatenate([part[each] for part in values]) for each in values[0]}
        else:
            columns[name] = np.concatenate(values)
    return type(parts[0])(**columns)


def place_points(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    *,
    points: tuple[NDArray[np.float32], NDArray[np.uint8]],
    viewpoints: NDArray[np.float64],
) -> bpy.types.Object:
    """Place points [N, 3] m with sRGB colours as squares that lie in their surfaces and face the viewpoints [V, 3]."""
    xyz, rgb = points
    grid = SurfaceGrid.of(xyz)
    normal = grid.normals(viewpoints)
    normal[~normal.any(axis=1)] = (0.0, 0.0, 1.0)  # an unknown one: any will do
    right, up = across(normal)
    half = grid.radii(_SMALLEST, _LARGEST)[:, None]
    squares = Squares(np.asarray(xyz, np.float32), right * half, up * half, rgb, np.ones(len(xyz), np.float32))
    return place_squares(owned, parent, key, name, squares)


def place_squares(
    owned: OwnedDataBlocks, parent: bpy.types.Collection, key: str, name: str, squares: Squares
) -> bpy.types.Object:
    """Return our object `key` with these squares: a mesh of their centres, with Col, right, up and opacity."""
    rgba = np.ones((len(squares.rgb), 4), np.float32)
    rgba[:, :3] = squares.rgb / np.float32(255)
    mesh: bpy.types.Mesh = owned.data(key, lambda: bpy.data.meshes.new(name))
    mesh.clear_geometry()
    mesh.vertices.add(len(squares.xyz))
    columns = {
        "position": ("FLOAT_VECTOR", squares.xyz),
        "right": ("FLOAT_VECTOR", squares.right),
        "up": ("FLOAT_VECTOR", squares.up),
        "Col": ("BYTE_COLOR", rgba),
        "opacity": ("FLOAT", squares.opacity),
    }
    set_attributes(mesh, columns | {name: ("INT", numbers) for name, numbers in squares.ids.items()})
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
    """Return two unit vectors for each unit normal [N, 3], float32 [N, 3] each, with first x second = normal."""
    aside = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])  # not parallel
    right = np.cross(aside, normal)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    return right.astype(np.float32), np.cross(normal, right).astype(np.float32)


def _new_group() -> bpy.types.NodeTree:
    """Make the node group that extrudes each vertex to its square, along `up`, then `right`, so that it shows its
    front. `corner` is in standard deviations."""
    tree = new_geometry_group("PLGS squares")

    def add(kind: str, column: int, row: int = 0, *inputs: object, **settings: object) -> bpy.types.Node:
        return add_node(tree, kind, column, -180 * row, *inputs, **settings)

    def maths(operation: str, column: int, row: int, *values: object) -> bpy.types.NodeSocket:
        node = add("ShaderNodeVectorMath", column, row, *values, operation=operation)
        return next(each for each in node.outputs if each.enabled)

    right, up, corner = (
        read_attribute(tree, name, 0, -180 * row) for row, name in enumerate(("right", "up", "corner"), 1)
    )
    first = maths("SCALE", 2, 1, maths("ADD", 1, 1, right, up), -1.0)
    sides = [maths("ADD", 1, 2 + row, each, each) for row, each in enumerate((up, right))]
    corners = [(-EXTENT, -EXTENT, 0.0), (0.0, 2 * EXTENT, 0.0), (2 * EXTENT, 0.0, 0.0)]
    away = _away_in_renders(add, maths, maths("CROSS_PRODUCT", 1, 4, right, up))
    kept = add("GeometryNodeDeleteGeometry", 3, 0, add("NodeGroupInput", 2).outputs[0], away).outputs[0]
    last = add("GeometryNodeSetPosition", 4, 0, kept, None, None, first).outputs[0]
    for step, step_in_deviations in enumerate(corners):
        column, selection = 5 + 2 * step, None
        if step:
            kind = ("VERTICES", "EDGES")[step - 1]
            drawn = add("GeometryNodeExtrudeMesh", column - 1, 0, last, None, sides[step - 1], 1.0, mode=kind)
            last, selection = drawn.outputs[0], drawn.outputs["Top"]
        moved = maths("ADD", column, 2, corner, step_in_deviations)
        store = partial(add, "GeometryNodeStoreNamedAttribute", data_type="FLOAT_VECTOR", domain="POINT")
        last = store(column, 0, last, selection, "corner", moved).outputs[0]
    add("NodeGroupOutput", 11, 0, last)
    return tree


def _away_in_renders(add: Any, maths: Any, normal: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes whose output says if a front faces away from the camera in a render; in views it is false."""
    camera = add("GeometryNodeInputActiveCamera", 0, 5).outputs[0]
    eye = add("GeometryNodeObjectInfo", 1, 5, camera, transform_space="RELATIVE").outputs["Location"]
    way = maths("SUBTRACT", 2, 5, add("GeometryNodeInputPosition", 0, 6).outputs[0], eye)
    is_viewport = add("GeometryNodeIsViewport", 1, 6).outputs[0]
    least = add("ShaderNodeMath", 2, 6, is_viewport, 1e9, operation="MULTIPLY").outputs[0]  # in views, never reached
    facing = maths("DOT_PRODUCT", 3, 4, normal, way)
    return add("ShaderNodeMath", 3, 5, facing, least, operation="GREATER_THAN").outputs[0]
