"""Points without classes as one mesh: in Solid shading each point has its own colour, unlike a point cloud's points.

The mesh has nothing but vertices: the points. A modifier makes each into a square, so squares take no room in the file.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .compat import new_geometry_group
from .materials import splat_material
from .owned import OwnedDataBlocks
from .surfaces import SurfaceGrid

_SMALLEST, _LARGEST = 0.002, 0.03
"""Limits to half the side of a square, metres."""
_MODIFIER = "Squares"


def place_points(
    owned: OwnedDataBlocks,
    parent: bpy.types.Collection,
    key: str,
    name: str,
    points: tuple[NDArray[np.float32], NDArray[np.uint8]],
    viewpoints: NDArray[np.float64],
) -> bpy.types.Object:
    """Place points without classes, xyz [N, 3] metres and rgb [N, 3] sRGB, as one mesh of squares that lie in their
    surfaces and face the viewpoints [V, 3]. Its vertices are the points, with Col and facing: the square's normal with
    the length of half its side.
    """
    xyz, rgb = points
    grid = SurfaceGrid.of(xyz)
    facing = grid.normals(viewpoints)
    facing[~facing.any(axis=1)] = (0.0, 0.0, 1.0)
    facing *= grid.radii(_SMALLEST, _LARGEST)[:, None]
    rgba = np.ones((len(rgb), 4), np.float32)
    rgba[:, :3] = rgb / np.float32(255)
    mesh: bpy.types.Mesh = owned.data(key, lambda: bpy.data.meshes.new(name))
    mesh.clear_geometry()
    mesh.vertices.add(len(xyz))
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(xyz, np.float32).ravel())
    mesh.attributes.new("facing", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", facing.ravel())
    mesh.attributes.new("Col", "BYTE_COLOR", "POINT").data.foreach_set("color_srgb", rgba.ravel())
    mesh.color_attributes.active_color = mesh.color_attributes["Col"]
    mesh.materials.clear()
    mesh.materials.append(splat_material(owned))
    mesh.update()
    ob = owned.object(key, name, mesh, parent)
    ob["points"] = len(xyz)
    modifier = ob.modifiers.get(_MODIFIER) or ob.modifiers.new(_MODIFIER, "NODES")
    modifier.node_group = owned.block("node_groups", "squares", _new_group)
    return ob


def _new_group() -> bpy.types.NodeTree:
    """Move each vertex to a corner of its square, draw it out to a side, and the side to the square. All that is made
    of a vertex has its attributes, and the mesh keeps its active colour. Drawn out in this order, up before right, the
    squares show their fronts along their normals.
    """
    tree = new_geometry_group("PLGS squares")
    tree.is_modifier = True
    link = tree.links.new

    def add(kind: str, column: int, row: int = 0) -> bpy.types.Node:
        node = tree.nodes.new(kind)
        node.location = (220 * column, -180 * row)
        return node

    facing, half = add("GeometryNodeInputNamedAttribute", 0, 1), add("ShaderNodeVectorMath", 1, 2)
    facing.data_type, facing.inputs["Name"].default_value = "FLOAT_VECTOR", "facing"
    found = next(socket for socket in facing.outputs if socket.enabled and socket.name == "Attribute")
    half.operation = "LENGTH"
    link(found, half.inputs[0])
    turn = add("FunctionNodeAlignRotationToVector", 1, 1)
    turn.axis = "Z"
    link(found, turn.inputs["Vector"])
    offsets = []
    for row, corner in enumerate([(-1.0, -1.0, 0.0), (0.0, 2.0, 0.0), (2.0, 0.0, 0.0)], start=1):
        turned, offset = add("FunctionNodeRotateVector", 2, row), add("ShaderNodeVectorMath", 3, row)
        turned.inputs["Vector"].default_value, offset.operation = corner, "SCALE"
        link(turn.outputs["Rotation"], turned.inputs["Rotation"])
        link(turned.outputs["Vector"], offset.inputs[0])
        link(half.outputs["Value"], offset.inputs["Scale"])
        offsets.append(offset.outputs["Vector"])
    start, opaque = add("NodeGroupInput", 3), add("GeometryNodeStoreNamedAttribute", 4)
    opaque.data_type, opaque.domain, opaque.inputs["Name"].default_value = "FLOAT", "POINT", "opacity"
    next(each for each in opaque.inputs if each.enabled and each.name == "Value").default_value = 1.0
    move = add("GeometryNodeSetPosition", 5)
    side, square = add("GeometryNodeExtrudeMesh", 6), add("GeometryNodeExtrudeMesh", 7)
    side.mode, square.mode = "VERTICES", "EDGES"
    for extrusion in (side, square):
        extrusion.inputs["Offset Scale"].default_value = 1.0
    chain = [start, opaque, move, side, square, add("NodeGroupOutput", 8)]
    for before, after in zip(chain, chain[1:], strict=False):
        link(before.outputs[0], after.inputs[0])
    for node, offset in zip((move, side, square), offsets, strict=True):
        link(offset, node.inputs["Offset"])
    return tree
