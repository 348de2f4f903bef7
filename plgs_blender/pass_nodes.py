"""The compositor nodes of a passes scene. Nodes are found by their tag, so users may move, rename and link
on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from . import compat
from .owned import KEY, tag

LAYER = "PLGS"
PASSES, INSTANCES, CLASSES = "passes", "CryptoInstance", "CryptoClass"
_STRENGTH = 0.55
"""How strongly the instances' colours lie over the picture."""


def node_of(tree: bpy.types.NodeTree, key: str) -> bpy.types.Node:
    """Our node `key`. KeyError when the user removed it."""
    for node in tree.nodes:
        if node.get(KEY) == key:
            return node
    raise KeyError(f"the compositor of the passes has no node {key!r} any more")


def has_nodes(tree: bpy.types.NodeTree | None) -> bool:
    """Whether these nodes were built there before, and none that we fill is missing."""
    keys = {node.get(KEY) for node in tree.nodes} if tree is not None else set()
    filled = {f"{what} {part}" for what in ("Instance", "Class") for part in ("palette", "scale")}
    return {PASSES, INSTANCES, CLASSES, *filled} <= keys


def output_of(tree: bpy.types.NodeTree, name: str) -> Any:
    """An output socket to link from: a layer ("Depth", "Semantic", ...), "Instance colours", "Class colours",
    "Instance matte", "Class matte" or "Overlay". KeyError when there is none.
    """
    key, output = {
        "Instance colours": ("Instance colours", "Image"),
        "Class colours": ("Class colours", "Image"),
        "Instance matte": (INSTANCES, "Matte"),
        "Class matte": (CLASSES, "Matte"),
        "Overlay": ("overlay", None),
    }.get(name, (PASSES, name))
    for socket in node_of(tree, key).outputs:
        if socket.enabled and output in (None, socket.name):
            return socket
    raise KeyError(f"the passes have no output {name!r}")


def use_image(tree: bpy.types.NodeTree, image: bpy.types.Image) -> None:
    """Let the passes node and both Cryptomatte nodes read an EXR's data-block."""
    for node in reading_nodes(tree):
        node.image = image
    node_of(tree, PASSES).layer = LAYER
    for key in (INSTANCES, CLASSES):
        node_of(tree, key).layer_name = key


def reading_nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """The nodes that read the EXR of the current view."""
    return (node_of(tree, key) for key in (PASSES, INSTANCES, CLASSES))


class NodeBuilder:
    """Adds tagged nodes in a tidy arrangement: columns of 220 units."""

    def __init__(self, tree: bpy.types.NodeTree, lift: str) -> None:
        self.tree, self._lift = tree, lift

    def add(self, key: str, label: str, column: float, row: float, *kinds: str) -> bpy.types.Node:
        return self.dress(compat.new_node(self.tree, *kinds), key, label, column, row)

    def dress(self, node: bpy.types.Node, key: str, label: str, column: float, row: float) -> bpy.types.Node:
        node.location, node.label, node.name = (220 * column, row), label, key
        tag(node, self._lift, key)
        return node

    def link(self, output: Any, target: Any) -> None:
        self.tree.links.new(output, target)


def build(tree: bpy.types.NodeTree, lift: str, image: bpy.types.Image) -> None:
    """All nodes and links, reading `image`; the result shows the instances' colours over the picture."""
    make = NodeBuilder(tree, lift)
    make.add(PASSES, "PLGS passes", 0, 200, "CompositorNodeImage")
    for key, label, row in ((INSTANCES, "Matte of instances", -320), (CLASSES, "Matte of classes", -720)):
        make.add(key, label, 0, row, "CompositorNodeCryptomatteV2").source = "IMAGE"
    use_image(tree, image)
    _colour_code(make, "Instance", "Instance", -60)
    _colour_code(make, "Class", "Semantic", -420)
    depth = make.add("depth", "Depth, near is black", 1.5, 400, "CompositorNodeNormalize")
    make.link(output_of(tree, "Depth"), depth.inputs[0])
    _show_overlay(make)


def _colour_code(make: NodeBuilder, what: str, layer: str, row: float) -> None:
    """Ids to colours: the id is a place in a palette, one pixel high, from which the nearest pixel is
    taken.
    """
    palette = make.add(f"{what} palette", f"{what} palette", 1.5, row - 170, "CompositorNodeImage")
    scale = make.add(f"{what} scale", "Id to place", 1.5, row, "ShaderNodeMath", "CompositorNodeMath")
    scale.operation = "MULTIPLY_ADD"
    place = make.add(f"{what} place", "Place", 2.4, row, "ShaderNodeCombineXYZ", "CompositorNodeCombineXYZ")
    place.inputs[1].default_value, place.inputs[2].default_value = 0.5, 1.0
    look_up = compat.new_palette_lookup(make.tree)
    make.dress(look_up, f"{what} colours", f"{what} colours", 3.2, row)
    make.link(output_of(make.tree, layer), scale.inputs[0])
    make.link(scale.outputs[0], place.inputs[0])
    make.link(palette.outputs[0], look_up.inputs["Image"])
    make.link(place.outputs[0], look_up.inputs["UV"])


def _show_overlay(make: NodeBuilder) -> None:
    """Where there is an instance, its colour over the picture; to the render result and the viewer."""
    is_there = make.add("is instance", "Is an instance", 2.4, 200, "ShaderNodeMath", "CompositorNodeMath")
    strength = make.add("strength", "Strength", 3.2, 200, "ShaderNodeMath", "CompositorNodeMath")
    is_there.operation, strength.operation = "GREATER_THAN", "MULTIPLY"
    is_there.inputs[1].default_value, strength.inputs[1].default_value = 0.5, _STRENGTH
    mix, factor, first, second, mixed = compat.new_colour_mix(make.tree)
    make.dress(mix, "overlay", "Instances over the picture", 4.1, 200)
    make.link(output_of(make.tree, "Instance"), is_there.inputs[0])
    make.link(is_there.outputs[0], strength.inputs[0])
    make.link(strength.outputs[0], factor)
    make.link(output_of(make.tree, "Combined"), first)
    make.link(output_of(make.tree, "Instance colours"), second)
    make.link(mixed, make.add("result", "", 5.0, 200, compat.COMPOSITE_OUTPUT).inputs[0])
    make.link(mixed, make.add("viewer", "", 5.0, 40, "CompositorNodeViewer").inputs[0])
