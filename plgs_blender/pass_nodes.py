"""The compositor nodes of a passes scene. Nodes are found by their tag, so users may move, rename and link them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from . import compat
from .owned import KEY, tag
from .panoptic_group import NAME, panoptic_group

LAYER = "PLGS"
PASSES, INSTANCES, CLASSES, PANOPTIC = "passes", "CryptoInstance", "CryptoClass", "panoptic"
_STRENGTH = 0.55
"""Opacity of the instances' colours over the picture."""
_LOWER = 240.0
"""How many units lower the nodes stand than Blender's own would, so that the picture behind them stays visible."""


_OUTPUTS = {
    "Instance colours": ("Instance colours", "Image"),
    "Class colours": ("Class colours", "Image"),
    "Instance matte": (INSTANCES, "Matte"),
    "Class matte": (CLASSES, "Matte"),
    "Overlay": (PANOPTIC, "Image"),
    "Matte": (PANOPTIC, "Matte"),
    "Outline": (PANOPTIC, "Outline"),
}
"""Node and socket of the outputs that are not layers."""


def node_of(tree: bpy.types.NodeTree, key: str) -> bpy.types.Node:
    """Our node `key`. KeyError when the user removed it."""
    for node in tree.nodes:
        if node.get(KEY) == key:
            return node
    raise KeyError(f"the compositor of the passes has no node {key!r} any more")


def has_nodes(tree: bpy.types.NodeTree | None) -> bool:
    """Whether these nodes were built there before, and no node that we fill is missing."""
    keys = {node.get(KEY) for node in tree.nodes} if tree is not None else set()
    filled = {f"{what} {part}" for what in ("Instance", "Class") for part in ("palette", "scale")}
    return {PASSES, INSTANCES, CLASSES, *filled} <= keys


def output_of(tree: bpy.types.NodeTree, name: str) -> Any:
    """An output socket to link from: a layer ("Depth", "Semantic", ...), "Instance colours", "Class colours",
    "Instance matte", "Class matte", "Overlay" (the group's picture), "Matte" or "Outline". KeyError when there is none.
    """
    key, output = _OUTPUTS.get(name, (PASSES, name))
    for socket in node_of(tree, key).outputs:
        if socket.enabled and output == socket.name:
            return socket
    raise KeyError(f"the passes have no output {name!r}")


def use_image(tree: bpy.types.NodeTree, image: bpy.types.Image) -> None:
    """Let the passes node and both Cryptomatte nodes read an EXR's data-block."""
    _ = image.size[:]  # Blender must read a file before a node can name one of its layers
    for node in reading_nodes(tree):
        node.image = image
    node_of(tree, PASSES).layer = LAYER
    for key in (INSTANCES, CLASSES):
        node_of(tree, key).layer_name = key


def reading_nodes(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """The nodes that read the EXR of the current view."""
    return (node_of(tree, key) for key in (PASSES, INSTANCES, CLASSES))


class _NodeBuilder:
    """Adds tagged nodes in a tidy arrangement: columns of 220 units."""

    def __init__(self, tree: bpy.types.NodeTree, lift: str) -> None:
        self.tree, self._lift = tree, lift

    def add(self, key: str, label: str, column: float, row: float, *kinds: str) -> bpy.types.Node:
        return self.dress(compat.new_node(self.tree, *kinds), key, label, column, row)

    def dress(self, node: bpy.types.Node, key: str, label: str, column: float, row: float) -> bpy.types.Node:
        node.location, node.label, node.name = (220 * column, row - _LOWER), label, key
        tag(node, self._lift, key)
        return node

    def link(self, output: Any, target: Any) -> None:
        self.tree.links.new(output, target)


def build(tree: bpy.types.NodeTree, lift: str, image: bpy.types.Image) -> None:
    """Build all nodes and links, which read `image`. The result shows the instances' colours over the picture."""
    make = _NodeBuilder(tree, lift)
    make.add(PASSES, "PLGS passes", 0, 200, "CompositorNodeImage")
    for key, label, row in ((INSTANCES, "Matte of instances", -320), (CLASSES, "Matte of classes", -720)):
        make.add(key, label, 0, row, "CompositorNodeCryptomatteV2").source = "IMAGE"
    use_image(tree, image)
    _colour_code(make, "Instance", "Instance", -60)
    _colour_code(make, "Class", "Semantic", -420)
    depth = make.add("depth", "Depth, near is black", 1.5, 80, "CompositorNodeNormalize")
    make.link(output_of(tree, "Depth"), depth.inputs[0])
    _show_panoptic(make)


def _colour_code(make: _NodeBuilder, what: str, layer: str, row: float) -> None:
    """Turn ids into colours: the id is a place in a palette one pixel high, whose nearest pixel is the colour."""
    palette = make.add(f"{what} palette", f"{what} palette", 1.5, row - 170, "CompositorNodeImage")
    scale = make.add(f"{what} scale", "Id to place", 1.5, row, "ShaderNodeMath", "CompositorNodeMath")
    scale.operation = "MULTIPLY_ADD"
    place = make.add(f"{what} place", "Place", 2.4, row, "ShaderNodeCombineXYZ", "CompositorNodeCombineXYZ")
    place.inputs[1].default_value, place.inputs[2].default_value = compat.IN_A_PIXEL, 1.0
    look_up = compat.new_palette_lookup(make.tree)
    make.dress(look_up, f"{what} colours", f"{what} colours", 3.2, row)
    make.link(output_of(make.tree, layer), scale.inputs[0])
    make.link(scale.outputs[0], place.inputs[0])
    make.link(palette.outputs[0], look_up.inputs["Image"])
    make.link(place.outputs[0], look_up.inputs["UV"])


def panoptic_node(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """The node with the group "PLGS Panoptic". KeyError when the user removed it."""
    return node_of(tree, PANOPTIC)


def _show_panoptic(make: _NodeBuilder) -> None:
    """Link the group's inputs, and its picture to the render result and the viewer."""
    node = make.add(PANOPTIC, NAME, 4.1, 200, "CompositorNodeGroup")
    node.node_tree, node.width = panoptic_group(), 200.0
    for name in ("Instance colours", "Class colours", "Instance matte", "Class matte", "Instance"):
        make.link(output_of(make.tree, name), node.inputs[name])
    make.link(output_of(make.tree, "Combined"), node.inputs["Image"])
    node.inputs["Overlay"].default_value = _STRENGTH
    image = node.outputs["Image"]
    make.link(image, make.add("result", "", 5.3, 200, compat.COMPOSITE_OUTPUT).inputs[0])
    make.link(image, make.add("viewer", "", 5.3, 40, "CompositorNodeViewer").inputs[0])
