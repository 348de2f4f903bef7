"""A modifier that hides the points between the active camera and the room: those that face away from it.

From outside, the near walls and the ceiling vanish and the room lies open, like a doll's house; from a
frame's own camera nothing is missing, for what a camera sees faces it. It is an ordinary modifier on the
clouds: its eye switches it off.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import bpy

from .materials import point_material
from .owned import OwnedDataBlocks

NAME = "Open room"


def open_room(owned: OwnedDataBlocks, clouds: Iterable[bpy.types.Object]) -> None:
    """Put the modifier on clouds that have the attribute `normal`; those that have it keep their settings."""
    for cloud in clouds:
        material, of_splats = (point_material(owned), "") if cloud.data.materials else (None, " of splats")
        group = owned.block("node_groups", f"open room{of_splats}", partial(_group, material))
        modifier = cloud.modifiers.get(NAME)
        if modifier is None:
            modifier = cloud.modifiers.new(NAME, "NODES")
        modifier.node_group = group


def _group(material: bpy.types.Material | None) -> bpy.types.NodeTree:
    """Delete a point where normal · (position - camera) > 0. Points whose normal is zero stay."""
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
