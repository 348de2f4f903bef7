"""Splats as objects: from 5.3 on, points that Blender itself draws as splats; and points as one mesh of squares, for
imported clouds and, before 5.3, the lift's Gaussians. From outside, a room lies open, like a doll's house.

The mesh has only vertices: the points. A modifier turns each into a square, so squares take no space in the file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, TypeVar

import bpy
import numpy as np
from numpy.typing import NDArray

from .clouds import SurfaceGrid
from .compat import forget_selection, new_geometry_group
from .materials import point_material, splat_material
from .owned import OwnedDataBlocks

NAME = "Open room"


def open_room(owned: OwnedDataBlocks, clouds: Iterable[bpy.types.Object]) -> None:
    """Put the modifier on clouds that have the attribute `normal`; those that already have it keep their settings."""
    for cloud in clouds:
        material, of_splats = (point_material(owned), "") if cloud.data.materials else (None, " of splats")
        group = owned.block("node_groups", f"open room{of_splats}", partial(_group, material))
        modifier = cloud.modifiers.get(NAME)
        if modifier is None:
            modifier = cloud.modifiers.new(NAME, "NODES")
        modifier.node_group = group


def _group(material: bpy.types.Material | None) -> bpy.types.NodeTree:
    """Delete a point if normal · (position - camera) > 0. Points with a zero normal stay."""
    tree = bpy.data.node_groups.new("PLGS open room", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    tree.is_modifier = True
    columns = {
        "NodeGroupInput": 0,
        "GeometryNodeInputActiveCamera": 0,
        "GeometryNodeObjectInfo": 1,
        "GeometryNodeInputPosition": 1,
        "GeometryNodeInputNamedAttribute": 2,
    }
    nodes = {}
    for row, (kind, column) in enumerate(columns.items()):
        nodes[kind] = tree.nodes.new(kind)
        nodes[kind].location = (220 * column, -160 * row)
    start, camera, place, position, normal = nodes.values()
    place.transform_space = "RELATIVE"
    normal.data_type = "FLOAT_VECTOR"
    normal.inputs["Name"].default_value = "normal"
    away, facing = tree.nodes.new("ShaderNodeVectorMath"), tree.nodes.new("ShaderNodeVectorMath")
    behind = tree.nodes.new("ShaderNodeMath")
    remove, dye = tree.nodes.new("GeometryNodeDeleteGeometry"), tree.nodes.new("GeometryNodeSetMaterial")
    end = tree.nodes.new("NodeGroupOutput")
    for column, node in enumerate((away, facing, behind, remove, dye, end), start=3):
        node.location = (220 * column, 0)
    away.operation, facing.operation, behind.operation = "SUBTRACT", "DOT_PRODUCT", "GREATER_THAN"
    behind.inputs[1].default_value = 0.0
    remove.domain = "POINT"
    link = tree.links.new
    link(camera.outputs[0], place.inputs["Object"])
    link(position.outputs[0], away.inputs[0])
    link(place.outputs["Location"], away.inputs[1])
    link(away.outputs["Vector"], facing.inputs[0])
    link(
        next(socket for socket in normal.outputs if socket.enabled and socket.name == "Attribute"),
        facing.inputs[1],
    )
    link(facing.outputs["Value"], behind.inputs[0])
    link(behind.outputs[0], remove.inputs["Selection"])
    link(start.outputs[0], remove.inputs["Geometry"])
    # Geometry nodes lose the materials of point clouds. Splats have none.
    dye.inputs["Material"].default_value = material
    dye.inputs["Selection"].default_value = material is not None
    link(remove.outputs[0], dye.inputs["Geometry"])
    link(dye.outputs[0], end.inputs[0])
    return tree


HARMONIC = 0.28209479177387814
_KIND, _BASE = "GAUSSIAN_SPLAT", "radiance:base"
_FIELDS = {"FLOAT_VECTOR": "vector", "QUATERNION": "value", "FLOAT4": "vector", "INT": "value",
           "BYTE_COLOR": "color_srgb"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Splats:
    """``xyz`` float32 [N, 3] m; ``deviations`` float32 [N, 3] m along axes rotated by ``turns`` float32 [N, 4],
    quaternions wxyz; ``opacity`` float32 [N]; ``rgb`` uint8 [N, 3] sRGB; ``normal`` float32 [N, 3]: a splat is hidden
    if it points away from the camera; ``ids`` int32 [N], by attribute name."""

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
    """Our object `key` with these splats, in the colours of their attribute Col; call `dye` after changing it."""
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
    for attribute, (kind, values) in columns.items():
        layer = cloud.attributes.get(attribute) or cloud.attributes.new(attribute, kind, "POINT")
        layer.data.foreach_set(_FIELDS[kind], np.ascontiguousarray(values).ravel())
    dye(cloud)
    ob = owned.object(key, name, cloud, parent)
    open_room(owned, [ob])
    ob["points"] = len(splats.xyz)
    return ob


def axes_of(turns: NDArray[np.float32]) -> NDArray[np.float32]:
    """The unit axes of Gaussians rotated by quaternions wxyz [M, 4], float32 [M, axis, xyz]."""
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
    """Give splats the colours of their attribute Col. Other clouds and meshes are left alone."""
    base = cloud.attributes.get(_BASE)
    if base is None:
        return
    values, colours = np.empty((2, len(base.data), 4), np.float32)
    base.data.foreach_get("vector", values.ravel())
    cloud.attributes["Col"].data.foreach_get("color_srgb", colours.ravel())
    values[:, :3] = (colours[:, :3] - 0.5) / HARMONIC
    base.data.foreach_set("vector", values.ravel())
    cloud.update_tag()


EXTENT = 2.0
"""Half the side of a square, in standard deviations of its fading colour."""
_SMALLEST, _LARGEST = 0.002, 0.03
"""Limits of half the side of a point's square, in metres."""
Part = TypeVar("Part")
_MODIFIER = "Squares"
_KINDS = {"right": "FLOAT_VECTOR", "up": "FLOAT_VECTOR", "Col": "BYTE_COLOR", "opacity": "FLOAT"}


@dataclass(frozen=True, eq=False)
class Squares:
    """``xyz`` float32 [N, 3] m; half sides ``right`` and ``up`` float32 [N, 3] m, whose cross product is the front's
    normal; ``rgb`` uint8 [N, 3] sRGB; ``opacity`` float32 [N]; ``ids`` int32 [N], by attribute name."""

    xyz: NDArray[np.float32]
    right: NDArray[np.float32]
    up: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    opacity: NDArray[np.float32]
    ids: Mapping[str, NDArray[np.int32]] = field(default_factory=dict)


def joined(parts: Sequence[Part]) -> Part:
    """Concatenates records of arrays [N, ...], and of such arrays by name."""
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
    face the viewpoints [V, 3]."""
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
    """Two unit vectors float32 [N, 3] perpendicular to each unit normal [N, 3] and each other: first x second =
    normal."""
    aside = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(aside, normal)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    return right.astype(np.float32), np.cross(normal, right).astype(np.float32)


def _new_group() -> bpy.types.NodeTree:
    """Extrude each vertex to its square, up before right, so that it shows its front. `corner` is in deviations."""
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
    """Whether, in a render, a front faces away from the camera: Cycles follows rays through only a few transparent
    layers."""
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
